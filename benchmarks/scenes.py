"""Methods on captures: trained one after the other for the same time or steps, judged on the same held-out
views.

    python -m benchmarks scenes [SCENE[:VIEWS] ...] [--sides "METHOD FLAGS" ...] [--minutes 2 | --steps N] [--output FILE.json]

Each side is a method with flags of `fprf train`, in one word: `--sides fprf-lite "fprf-splats --cells 4"`.
`SCENE:9` trains on nine of its training views, evenly through the capture, and on the sparse points that two
of them saw; held-out views stay what they are. Images are reduced by whole numbers until the longer side has
at most `--side` pixels. `--disturb 0.5 0.005` turns the training views by 0.5 degrees about random axes and
shifts them by 0.5 % of the cameras' extent; `--fit-poses` judges held-out views once more after their poses
were fitted. Kernels are compiled and features are there before anything is timed. Each scene is an entry of the
file with its own commit.
"""

import json
import math
import os
import shlex
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.atomic import write_json
from fprf.rendering.paths import transforms
from fprf.training.camera_optimizers import rotated

from .common import add_entry, arguments, cost_of


def main(argv: list[str]) -> None:
    parser = arguments("scenes", __doc__)
    parser.add_argument(
        "scenes", nargs="*", default=["garden"], help="folders; FOLDER:N is thinned to N training views"
    )
    parser.add_argument(
        "--sides", nargs="+", default=["fprf-lite", "fprf-splats"], help="methods with their flags"
    )
    parser.add_argument("--minutes", type=float, default=2.0, help="of training, wall time")
    parser.add_argument("--steps", type=int, help="of training, in place of the minutes")
    parser.add_argument("--side", type=int, default=320, help="longest side of the images at most, in pixels")
    parser.add_argument("--disturb", type=float, nargs=2, default=(0.0, 0.0), metavar=("DEGREES", "SHARE"))
    parser.add_argument("--fit-poses", action="store_true", help="of held-out views, judged once more")
    parser.add_argument("--seed", type=int, default=0, help="of the disturbance")
    parser.add_argument("--output", type=Path, help="JSON file that the figures are added to")
    asked = parser.parse_args(argv)
    limit = ["--steps", "1000000", "--minutes", str(asked.minutes)]
    limit = ["--steps", str(asked.steps)] if asked.steps else limit
    for text in asked.scenes:
        folder, _, count = text.partition(":")
        source = Path(folder)
        scene = parse_scene(source, 1, None)
        downscale = math.ceil(int(scene.cameras.size.max()) / asked.side)
        size = scene.cameras.scaled(downscale).size[0].tolist()
        views = int(count) if count else len(scene.train)
        row: dict[str, Any] = {
            "training_views": views,
            "held_out_views": len(scene.test),
            "size": size,
            "limit": limit,
        }
        with tempfile.TemporaryDirectory() as scratch:
            if count or any(asked.disturb):
                degrees, share = asked.disturb
                source = rewritten(source, Path(scratch) / source.name, views, degrees, share, asked.seed)
            for number, side in enumerate(asked.sides):
                row[side] = judged(
                    side, source, Path(scratch) / str(number), downscale, limit, fit_poses=asked.fit_poses
                )
        row["load_average"] = os.getloadavg()[0]
        add_entry(asked.output, Path(folder).name + (f", {count} views" if count else ""), row)


def judged(
    side: str, data: Path, folder: Path, downscale: int, limit: list[str], *, fit_poses: bool
) -> dict[str, Any]:
    """Train one side and evaluate it; what both took and reached."""
    train = ["train", *shlex.split(side), "--data", str(data), "--downscale", str(downscale)]
    cost_of(*train, "--output", folder / "first", "--steps", "1")
    cost = cost_of(*train, "--output", folder / "run", *limit)
    cost_of("eval", folder / "run", "--no-images", "--fit-poses", str(fit_poses).lower())
    found = json.loads((folder / "run" / "metrics.json").read_text())
    wanted = ("psnr", "ssim", "lpips", "psnr_fitted_poses", "train_steps", "gaussians", "seconds_per_view")
    return cost._asdict() | {name: found[name] for name in wanted if name in found}


def rewritten(source: Path, folder: Path, views: int, degrees: float, share: float, seed: int) -> Path:
    """The scene as a folder with so many of its training views, which stand and look a little elsewhere.

    Of the sparse points those stay that two of these views saw, as far as the capture says who saw which.
    """
    scene = parse_scene(source, 1, None)
    train = scene.train[np.linspace(0, len(scene.train) - 1, views).round().astype(np.int64)]
    kept = torch.cat([train, scene.test]).sort().values
    pose = scene.cameras.pose.clone()
    draw = torch.Generator().manual_seed(seed)
    extent = float((pose[:, :, 3].amax(0) - pose[:, :, 3].amin(0)).norm())
    for view in train.tolist():
        axis, way = torch.nn.functional.normalize(
            torch.randn(2, 3, generator=draw, dtype=torch.float64), dim=-1
        )
        pose[view, :, :3] = rotated(pose[view, :, :3].T, (math.radians(degrees) * axis).expand(3, 3)).T
        pose[view, :, 3] += share * extent * way
    (folder / "images").mkdir(parents=True)
    names = [f"images/{number:05d}{scene.paths[view].suffix}" for number, view in enumerate(kept.tolist())]
    for name, view in zip(names, kept.tolist(), strict=True):
        (folder / name).symlink_to(scene.paths[view].resolve())
    place = {view: number for number, view in enumerate(kept.tolist())}
    learnt, held = ([place[view] for view in part.tolist()] for part in (train, scene.test))
    cameras = replace(scene.cameras, pose=pose).select(kept)
    write_json(folder / "transforms.json", transforms(cameras, names, train=learnt, test=held))
    if scene.points is not None:
        if scene.seen is None:
            np.savez(folder / "points.npz", xyz=scene.points.numpy())
        else:
            seen = scene.seen.numpy()
            often = np.bincount(seen[np.isin(seen[:, 0], train), 1], minlength=len(scene.points)) >= 2
            seen = seen[np.isin(seen[:, 0], kept) & often[seen[:, 1]]]
            numbers = np.stack([np.searchsorted(kept, seen[:, 0]), (np.cumsum(often) - 1)[seen[:, 1]]], 1)
            np.savez(folder / "points.npz", xyz=scene.points.numpy()[often], seen=numbers)
    return folder
