"""More images than memory: batches of a scene whose pixels are several times what the process may allocate.

    python -m benchmarks many_images [--images 12000] [--size 256 192] [--limit 1024] [--output FILE]

The images are made here (JPEG, one camera a picture). A process of its own is held to `--limit` MiB of memory that it may
write to (RLIMIT_DATA: what is mapped from files does not count, since the system can take it back) and draws batches as the
surroundings of a scene of blocks do, from all pixels. A second one is told to hold the pixels in memory, and cannot.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

from .common import RESULTS, arguments, report


def write_scene(folder: Path, count: int, size: tuple[int, int]) -> None:
    """Images of a colour and a gradient each, and their transforms.json; what is there stays."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    across, down = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    shade = np.stack([across, down, 1 - across], -1)
    frames = []
    for k in range(count):
        path = folder / "images" / f"{k:06d}.jpg"
        if not path.is_file():
            tint = np.random.default_rng(k).random(3)
            cv2.imwrite(str(path), (255 * (0.5 * shade + 0.5 * tint)).astype(np.uint8))
        pose = np.eye(4)
        pose[:3, 3] = (0.5 * (k % 200), 0.5 * (k // 200), 1.5)
        frames.append({"file_path": f"images/{path.name}", "transform_matrix": pose.tolist()})
    camera = {"w": size[0], "h": size[1], "fl_x": float(size[0]), "fl_y": float(size[0])}
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": frames}))


def status(*names: str) -> dict[str, float]:
    """MiB of some lines of /proc/self/status."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return {f"{name}_mib": int(lines[name].split()[0]) / 1024 for name in names}


def part(folder: Path, cache: Path, limit: int, batches: int, held: bool) -> dict[str, Any]:
    """What the process of its own does."""
    import torch

    from fprf.datamanagers import batches as module
    from fprf.datamanagers.config import RayBatchesConfig
    from fprf.datamanagers.parsers.config import parse_scene

    scene = parse_scene(folder, 1, None)
    resource.setrlimit(resource.RLIMIT_DATA, (limit << 20, limit << 20))
    start = time.perf_counter()
    allocate = partial(module.allocate_pixels, held=sys.maxsize) if held else module.allocate_pixels
    with patch.object(module, "allocate_pixels", allocate):
        manager = RayBatchesConfig(rays=2048).build(scene=scene, content=None, semantic=None, dim=0, cache=cache, seed=0)
    loaded = time.perf_counter() - start
    start, seen = time.perf_counter(), set()
    for step in range(batches):
        batch = manager.batch(step)
        seen |= set(torch.unique(batch.view).tolist())
    spent = (time.perf_counter() - start) / batches
    return {
        "seconds_to_decode": loaded,
        "seconds_a_batch_of_2048": spent,
        "images_met": len(seen),
        **status("VmData", "RssAnon", "RssFile", "VmHWM"),
    }


def main(argv: list[str]) -> None:
    parser = arguments("many_images", __doc__)
    parser.add_argument("--images", type=int, default=12_000)
    parser.add_argument("--size", type=int, nargs=2, default=(256, 192))
    parser.add_argument("--limit", type=int, default=1024, help="MiB that the process may allocate")
    parser.add_argument("--batches", type=int, default=50)
    parser.add_argument("--scratch", type=Path, default=Path("runs/many_images"))
    parser.add_argument("--output", type=Path, default=RESULTS / "many_images.json")
    parser.add_argument("--part", choices=("mapped", "held"), help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    folder, cache = options.scratch / "scene", options.scratch / "cache"
    if options.part:
        print(json.dumps(part(folder, cache, options.limit, options.batches, options.part == "held")))
        return
    write_scene(folder, options.images, tuple(options.size))
    result: dict[str, Any] = {
        "images": options.images,
        "size": list(options.size),
        "pixels_mib": 3 * options.images * options.size[0] * options.size[1] * 7 // 8 / 2**20,
        "limit_mib": options.limit,
    }
    words = ["--images", str(options.images), "--limit", str(options.limit), "--batches", str(options.batches)]
    for name in ("mapped", "held"):
        command = [sys.executable, "-m", "benchmarks", "many_images", *words, "--scratch", str(options.scratch), "--part", name]
        found = subprocess.run(command, capture_output=True, text=True, check=False)
        told = found.stderr.strip().splitlines()[-1:] or [""]
        result[name] = json.loads(found.stdout) if found.returncode == 0 else {"exit": found.returncode, "told": told[0][:200]}
    print(json.dumps(result, indent=1))
    report(options.output, result)
