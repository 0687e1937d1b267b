"""Fields and Gaussians on the same captures: equal wall seconds, size and threads, judged on the same held-out views.

    python -m benchmarks methods SCENE[:VIEWS] ... --output FILE.json [--minutes 2] [--side 320] [--only METHOD ...]

`SCENE:9` trains on nine of its training views (see `first_use`). Images are reduced by whole numbers until the longer side has
at most `--side` pixels. Seconds count training with its features, not the imports; the fields distil semantics as well, the
Gaussians carry none. Kernels are compiled before. Each scene is an entry with its own commit.
"""

import json
import math
import os
import tempfile
from pathlib import Path
from typing import Any

from fprf.datamanagers.parsers.config import parse_scene

from .common import add_entry, arguments
from .first_use import thinned
from .gaussians import command

METHODS = ("fprf-lite", "fprf-splats")


def main(argv: list[str]) -> None:
    parser = arguments("methods", __doc__)
    parser.add_argument("scenes", nargs="+", help="folders; FOLDER:N is thinned to N training views")
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--side", type=int, default=320, help="longest side of the images at most, in pixels")
    parser.add_argument("--only", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--keep", type=Path, help="folder that the runs are kept in")
    parser.add_argument("--output", type=Path, required=True, help="JSON file that the figures are added to")
    args = parser.parse_args(argv)
    for text in args.scenes:
        folder, _, count = text.partition(":")
        with tempfile.TemporaryDirectory() as scratch:
            place = Path(scratch)
            data = thinned(Path(folder), place / Path(folder).name, int(count)) if count else Path(folder)
            rows = compared(data, args.keep / text.replace("/", "-").strip("-") if args.keep else place, args)
        name = Path(folder).name + (f", {count} views" if count else "")
        add_entry(args.output, name, {"minutes": args.minutes, "load_average": os.getloadavg()[0], **rows})
        print(name, json.dumps(rows), flush=True)


def compared(data: Path, place: Path, args: Any) -> dict[str, Any]:
    """Train and judge every method on one capture."""
    scene = parse_scene(data, 1, None)
    downscale = math.ceil(int(scene.cameras.size.max()) / args.side)
    size = scene.cameras.scaled(downscale).size[0].tolist()
    rows: dict[str, Any] = {"training_views": len(scene.train), "held_out_views": len(scene.test), "size": size}
    for method in args.only:
        run = place / method
        wanted = ("--downscale", str(downscale), "--steps", "100000", "--minutes", str(args.minutes))
        _, processor, memory = command("train", method, "--data", str(data), "--output", str(run), *wanted)
        command("eval", str(run))
        figures = json.loads((run / "metrics.json").read_text())
        rows[method] = {
            "psnr": figures["psnr"],
            "ssim": figures["ssim"],
            "steps": figures["train_steps"],
            "processor_seconds": processor,
            "peak_rss_mib": memory,
        }
    return rows
