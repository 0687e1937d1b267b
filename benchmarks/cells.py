"""Captures trained in cells, in one piece and in blocks of fields: equal processor seconds, size, and number of Gaussians.

    python -m benchmarks cells SCENE ... [--steps 3000] [--share 1.0] [--cells 4] [--output FILE.json]

The piece is trained for `--steps`, the cells for `--share` of them (their first steps, of images of half the size, are cheaper,
each step after that serves one cell: the share at which both take as long depends on the scene), blocks of `fprf-lite` for the
seconds that the piece took, features not counted. Seconds are those of the processor, imports included. The error at borders is
that of pixels within three of a change of the cell that what they show lies in, in held-out views, over that of all others.
Each scene is an entry with its own commit.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from fprf.datamanagers.images import load_images
from fprf.rendering.cameras import pixel_grid, rays_through
from fprf.splats.cells import load_cells
from fprf.splats.config import GaussiansConfig
from fprf.splats.loading import open_gaussians
from fprf.training.prepare import read_scene
from fprf.training.quality import QualityConfig
from fprf.training.run import Run

from .common import ROOT, add_entry, arguments
from .gaussians import command

_NEAR = 7
"""Pixels across the neighbourhood in which another cell makes a border."""


def trained(data: Path, run: Path, flags: list[str]) -> dict[str, Any]:
    _, processor, memory = command("train", "fprf-splats", "--data", str(data), "--output", str(run), *flags)
    command("eval", str(run))
    found = json.loads((run / "metrics.json").read_text())
    return {"processor_seconds": processor, "peak_rss_mib": memory} | {
        key: found[key] for key in ("psnr", "ssim", "gaussians", "train_steps", "views")
    }


@torch.inference_mode()
def borders(run: Path, data: Path) -> dict[str, float]:
    """Mean absolute error of held-out views at borders of cells over that elsewhere, and the share of the pixels there."""
    config = Run(run).load_config()[0]
    assert isinstance(config, GaussiansConfig)
    scene, cells = read_scene(replace(config, data=data)), load_cells(run)
    opened = open_gaussians(Run(run), config, "cpu", QualityConfig())
    cameras = opened.known.cameras
    sums, counts = np.zeros(2), np.zeros(2)
    for view in opened.known.split("test"):
        shown = opened.scene.as_taken(view).render(cameras, view)
        origin, direction = rays_through(cameras, torch.full((shown.depth.numel(),), view), pixel_grid(cameras, view))
        points = origin + direction * shown.depth.reshape(-1, 1)
        owner = torch.stack([cell.holds(points) for cell in cells]).int().argmax(0).view(shown.depth.shape).numpy()
        around = np.ones((_NEAR, _NEAR), np.uint8)
        marks = owner.astype(np.uint8)
        border = (cv2.dilate(marks, around) != cv2.erode(marks, around)).astype(int)
        image = load_images(scene, config.background, [view])[0].astype(np.float64) / 255
        error = np.abs(shown.rgb.numpy() - image).mean(2)
        for kind in (0, 1):
            sums[kind] += error[border == kind].sum()
            counts[kind] += (border == kind).sum()
    return {"border_error_over_inside": float(sums[1] / counts[1] / (sums[0] / counts[0])), "share": counts[1] / counts.sum()}


def blocks(data: Path, place: Path, downscale: int, seconds: float) -> dict[str, Any]:
    file = place / "blocks.json"
    own = ["--minutes", str(seconds / 60), "--sides", "blocks", "--scratch", str(place), "--output", str(file)]
    flags = ["--blocks", "grid", "--datamanager.rays", "256", "--downscale", str(downscale)]
    line = [sys.executable, "-m", "benchmarks", "blocks_scenes", str(data), *own, "--", *flags]
    subprocess.run(line, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    found = json.loads(file.read_text())[data.name]["blocks"]
    return {key: found[key] for key in ("psnr", "seconds", "steps", "blocks")}


def main(argv: list[str]) -> None:
    parser = arguments("cells", __doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--side", type=int, default=640, help="longest side of the images at most, in pixels")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--share", type=float, default=1.0, help="of the steps, for the cells")
    parser.add_argument("--cap", type=int, default=60_000)
    parser.add_argument("--cells", type=int, default=4)
    parser.add_argument("--only", nargs="+", choices=("piece", "cells", "blocks"), default=("piece", "cells", "blocks"))
    parser.add_argument("--output", type=Path)
    args = parser.parse_args(argv)
    for data in (each.resolve() for each in args.scenes):
        size = read_scene(GaussiansConfig(data=data)).cameras.size
        downscale = math.ceil(int(size.max()) / args.side)
        flags = ["--downscale", str(downscale), "--initial", str(args.cap), "--cap", str(args.cap)]
        row: dict[str, Any] = {"downscale": downscale, "cap": args.cap, "cells": args.cells}
        with tempfile.TemporaryDirectory() as scratch:
            place = Path(scratch)
            command("train", "fprf-splats", "--data", str(data), *flags, "--steps", "1", "--output", str(place / "first"))
            if "piece" in args.only:
                row["one_piece"] = trained(data, place / "piece", [*flags, "--steps", str(args.steps)])
            if "cells" in args.only:
                steps = round(args.share * args.steps)
                several = ["--steps", str(steps), "--cells", str(args.cells)]
                row["in_cells"] = trained(data, place / "cells", [*flags, *several]) | borders(place / "cells", data)
            if "blocks" in args.only:
                row["fprf_lite_blocks"] = blocks(data, place, downscale, row["one_piece"]["processor_seconds"])
        row["load_average"] = os.getloadavg()[0]
        print(data.name, json.dumps(row), flush=True)
        if args.output is not None:
            add_entry(args.output, data.name, row)
