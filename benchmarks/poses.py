"""Poses that are off, and what refining them wins back.

    python -m benchmarks poses [SCENE] [--method NAME] [--steps 3000] [--degrees 0.5] [--share 0.005] [--output FILE] -- [field]

Without a scene, the town. Its training views are turned by so many degrees about random axes and shifted by a share of
the cameras' extent in random directions; then it is trained with its true poses, with the wrong ones, and with the wrong ones
refined, for the same steps. A folder whose poses are not exact (`--as-given`) is trained as it is, with and without refining.

Held-out views are judged where they were taken (true poses; the scene may lie a little elsewhere, where its training views put
it) and with their own pose fitted to their image (`fprf eval --fit-poses`): both for all sides. Errors of poses are those
of the training views, after the similarity that brings their centres nearest to the true ones.
"""

import json
import math
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fprf.cli.eval import EvalConfig, evaluate
from fprf.cli.parsing import load_method, parse
from fprf.config import RunConfig, TrainConfig
from fprf.datamanagers.parsers.config import parse_scene
from fprf.rendering.cameras import Cameras
from fprf.training.camera_optimizers import rotated
from fprf.training.driver import train
from fprf.training.loading import open_run
from fprf.training.prepare import read_scene

from .common import add_entry, arguments, split_flags
from .town.write import scene_folder


def perturbed(source: Path, folder: Path, degrees: float, share: float, seed: int) -> Path:
    """A copy of a scene (images are links) whose training views stand and look a little elsewhere."""
    scene = parse_scene(source, 1, None)
    document = json.loads((source / "transforms.json").read_text())
    folder.mkdir(parents=True, exist_ok=True)
    for path in source.iterdir():
        if path.name != "transforms.json" and not (folder / path.name).exists():
            (folder / path.name).symlink_to(path.resolve())
    draw = torch.Generator().manual_seed(seed)
    size = extent(scene.cameras)
    train = {scene.paths[view].name for view in scene.train.tolist()}
    for frame in document["frames"]:
        axis, way = torch.nn.functional.normalize(torch.randn(2, 3, generator=draw, dtype=torch.float64), dim=-1)
        if Path(frame["file_path"]).name not in train:
            continue
        pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
        turn = math.radians(degrees) * axis
        pose[:3, :3] = rotated(pose[:3, :3].T, turn.expand(3, 3)).T
        pose[:3, 3] += share * size * way
        frame["transform_matrix"] = pose.tolist()
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def extent(cameras: Cameras) -> float:
    """Diagonal of the cameras' bounds, world units."""
    centre = cameras.pose[:, :, 3]
    return float((centre.amax(0) - centre.amin(0)).norm())


def errors(found: Cameras, true: Cameras, views: Tensor) -> dict[str, float]:
    """Root mean square error of centres (share of the extent) and turns (degrees), after the best similarity.

    Its turn is fitted to centres and axes together: cameras along a line say nothing about turns around it.
    """
    a, b = found.pose[views, :, 3], true.pose[views, :, 3]
    middle_a, middle_b = a.mean(0), b.mean(0)
    from_centres = (b - middle_b).T @ (a - middle_a) / extent(true) ** 2
    from_axes = (true.pose[views, :, :3] @ found.pose[views, :, :3].transpose(1, 2)).sum(0)
    u, _, vt = torch.linalg.svd(from_centres + from_axes)
    turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vt).sign())], dtype=a.dtype)) @ vt
    scale = float(((a - middle_a) @ turn.T * (b - middle_b)).sum() / (a - middle_a).square().sum())
    moved = scale * (a - middle_a) @ turn.T + middle_b
    apart = (turn @ found.pose[views, :, :3]).transpose(1, 2) @ true.pose[views, :, :3]
    angle = torch.acos(((apart.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1))
    return {
        "centre_rms_share_of_extent": float((moved - b).square().sum(-1).mean().sqrt()) / extent(true),
        "turn_rms_degrees": math.degrees(float(angle.square().mean().sqrt())),
    }


def run_one(config: RunConfig, method: str, true: Cameras | None) -> dict[str, Any]:
    """Train and judge, by the verbs that users call."""
    assert config.output is not None
    train(config, method, quiet=True)
    asked = EvalConfig(run=config.output, images=False, device="cpu")
    given = evaluate(asked)
    after: dict[str, Any] = evaluate(replace(asked, fit_poses=True))
    result = {
        "psnr": given["psnr"],
        "psnr_poses_fitted": after["psnr"],
        "fitted_turn_degrees": statistics.mean(move["turn_degrees"] for move in after["fitted_poses"].values()),
        "steps": given["train_steps"],
        "seconds": given["train_seconds"],
    }
    if true is not None:
        known = open_run(config.output, "cpu").known
        result["training_views"] = errors(known.cameras, true, torch.tensor(known.train))
    print(config.output.name, json.dumps(result), flush=True)
    return result


def main(argv: list[str]) -> None:
    parser = arguments("poses", __doc__)
    parser.add_argument("scene", type=Path, nargs="?", default=Path("town"))
    parser.add_argument("--as-given", action="store_true", help="the scene's poses are refined as they are")
    parser.add_argument("--method", default="fprf-lite")
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--rate", type=float, default=0.015, help="`--poses` of the refined side")
    parser.add_argument("--degrees", type=float, default=0.5)
    parser.add_argument("--share", type=float, default=0.005, help="of the cameras' extent")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sides", nargs="+", default=("true", "wrong", "refined"))
    parser.add_argument("--scratch", type=Path, default=Path("runs/poses"))
    parser.add_argument("--output", type=Path, help="JSON file that the figures are added to, under the scene's name")
    own, flags_behind = split_flags(argv)
    options = parser.parse_args(own)
    method, _ = load_method(options.method)
    flags = ["--data", str(scene_folder(options.scene)), "--steps", str(options.steps), *flags_behind]
    base = parse(method, flags, prog="poses", description="")
    base = replace(base, downscale=base.downscale or 1)
    source = read_scene(base).paths[0].parents[1]
    scratch = options.scratch.resolve() / source.name
    true = None if options.as_given else parse_scene(source, base.downscale, None).cameras
    data = (
        source if options.as_given else perturbed(source, scratch / "perturbed", options.degrees, options.share, options.seed)
    )
    if isinstance(base, TrainConfig):
        plain: RunConfig = replace(base, device="cpu", datamanager=replace(base.datamanager, parser=None))
    else:
        plain = replace(base, parser=None)
    sides = {
        "true": replace(plain, data=source),
        "wrong": replace(plain, data=data),
        "refined": replace(plain, data=data, poses=options.rate),
    }
    result: dict[str, Any] = {
        "flags": flags_behind,
        "steps": options.steps,
        "rate": options.rate,
        "threads": torch.get_num_threads(),
    }
    if true is not None:
        result |= {"degrees": options.degrees, "share_of_extent": options.share, "extent": extent(true)}
    for side in options.sides:
        result[side] = run_one(replace(sides[side], output=scratch / options.method / side), options.method, true)
    if options.output is not None:
        name = source.name if options.method == "fprf-lite" else f"{source.name} {options.method}"
        add_entry(options.output, name, result)
