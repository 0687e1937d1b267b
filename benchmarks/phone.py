"""A folder as a phone gives it (the town's views as JPEG, no poses) to a restyled scene, by `process` and the lines it prints.

    python -m benchmarks phone WORK [--output benchmarks/results/phone.json] [--picture FILE.jpg]

WORK holds everything that is made; lines that have run are not repeated. Needs the extra `sfm`.
"""

import json
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fprf.cli.parsing import parse
from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import UsageError
from fprf.io.atomic import write_json
from fprf.io.images import to_uint8, write_image

from .common import ROOT, report
from .pictures import sheet, town_reference
from .town.write import write_town

sys.path.insert(0, str(ROOT / "tests" / "reconstruction"))  # the tests' own measure of poses

from alignment import misses

PROCESS = ("process", "my_photos", "--output", "my_scene")


@dataclass(frozen=True, kw_only=True)
class PhoneConfig:
    """How large the capture is."""

    work: Path = Path()
    """A folder for everything that is made."""
    views: int = 40
    """Photographs."""
    quality: int = 92
    """Of the JPEG files."""
    output: Path | None = None
    """JSON file for the figures."""
    picture: Path | None = None
    """A sheet: captured, rendered, in two styles."""


def execute(words: Sequence[str], work: Path, done: dict[str, Any]) -> None:
    """Run a line of fprf in the folder, unless it has been run; note its seconds and what it printed."""
    if words[0] in done:
        return
    start = time.monotonic()
    print("fprf", *words, flush=True)
    ended = subprocess.run([sys.executable, "-m", "fprf", *words], cwd=work, check=False, stdout=subprocess.PIPE, text=True)
    if ended.returncode:
        raise UsageError(f"`fprf {' '.join(words)}` failed in {work}; see above")
    done[words[0]] = {
        "line": shlex.join(["fprf", *words]),
        "seconds": round(time.monotonic() - start, 1),
        "printed": ended.stdout.splitlines()[-2:],
    }
    write_json(work / "lines.json", done)


def photographs(config: PhoneConfig) -> None:
    """The town and its pictures as a phone would name them; two references from another town."""
    work = config.work
    write_town(work / "town", seed=0, palette="day", views=config.views, width=640, height=480)
    (work / "my_photos").mkdir(exist_ok=True)
    for number, path in enumerate(sorted((work / "town" / "images").glob("*.png"))):
        file = work / "my_photos" / f"IMG_{number:04d}.jpg"
        cv2.imwrite(str(file), cv2.imread(str(path)), [cv2.IMWRITE_JPEG_QUALITY, config.quality])
    for name in ("autumn", "night"):
        write_image(work / f"{name}.jpg", to_uint8(town_reference(name).image))


def poses(work: Path) -> dict[str, float]:
    """How far what was found is from the truth."""
    found, truth = parse_scene(work / "my_scene", 1, None), parse_scene(work / "town", 1, None)
    numbers = [int(path.stem.removeprefix("IMG_")) for path in found.paths]
    miss = misses(found.cameras.pose.numpy(), truth.cameras.pose[numbers].numpy())
    focal = float(found.cameras.focal[0, 0] / truth.cameras.focal[0, 0])
    return {
        "posed": len(numbers),
        "photographs": len(truth.paths),
        "position_largest": miss.position,
        "position_rms": miss.rms,
        "degrees_largest": miss.degrees,
        "focal_ratio": focal,
    }


def main(argv: list[str]) -> None:
    config = parse(PhoneConfig(), argv, prog="python -m benchmarks phone", description=__doc__ or "", positional=("work",))
    work = config.work
    work.mkdir(parents=True, exist_ok=True)
    log = work / "lines.json"
    done: dict[str, Any] = json.loads(log.read_text()) if log.is_file() else {}
    if not (work / "night.jpg").is_file():
        photographs(config)
    execute(PROCESS, work, done)
    train, stylize = (shlex.split(line)[1:] for line in done["process"]["printed"])
    execute(train, work, done)
    execute(["eval", stylize[1]], work, done)
    execute([*stylize[:-1], "autumn.jpg", "night.jpg", "--split", "test"], work, done)
    figures: dict[str, Any] = {"poses": poses(work), "lines": done}
    run = work / stylize[1]
    metrics = json.loads((run / "metrics.json").read_text())
    figures |= {key: metrics[key] for key in ("psnr", "ssim", "train_seconds", "train_steps")}
    print(json.dumps(figures, indent=1))
    if config.output is not None:
        report(config.output, figures)
    if config.picture is not None:
        write_image(config.picture, sheet([row(work, run, name) for name in held_out(run)]))


def held_out(run: Path) -> list[str]:
    """Three views that nothing was trained on."""
    names = sorted(path.stem for path in (run / "renders" / "test").glob("IMG_*.png") if "." not in path.stem)
    return [names[round(k * (len(names) - 1) / 2)] for k in range(3)]


def row(work: Path, run: Path, name: str) -> dict[str, Any]:
    """One view: captured, rendered, restyled."""
    import torch

    files = {"photograph": work / "my_photos" / f"{name}.jpg", "rendered": run / "renders" / "test" / f"{name}.png"}
    files |= {file.parent.name: file for file in sorted((run / "styles").glob(f"*/{name}.png"))}
    shown = {key: np.asarray(load_image(path)) for key, path in files.items()}
    return {key: torch.from_numpy(picture).float() / 255 for key, picture in shown.items()}
