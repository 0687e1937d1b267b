"""A capture in other coordinates: projected metres, Earth-centred ones, millimetres and kilometres, against its own.

    python -m benchmarks coordinates SCENE [--method NAME] [--steps 600] [--output FILE] -- [field]

The same photographs with their poses and points scaled and shifted in float64, trained with the same seed for the same steps.
Each run is judged on its held-out views and exported: positions in the file, less the shift, against those in its checkpoint.
Runs of Gaussians are restyled as captures too: colours of the moved file against those of the file in its own units.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

import fprf
from fprf.cli.eval import EvalConfig, evaluate
from fprf.cli.main import main as run_verb
from fprf.cli.parsing import load_method, parse
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import Scene
from fprf.export.transforms import transforms
from fprf.io.atomic import write_json
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import Gaussians
from fprf.splats.scene import SplatScene
from fprf.training.driver import train
from fprf.training.loading import open_run
from fprf.types import Origin

from .common import RESULTS, add_entry, arguments, split_flags

REFERENCE = Path(fprf.__file__).parent / "garden" / "references" / "autumn.jpg"
MOVES: dict[str, tuple[float, Origin]] = {
    "own units": (1.0, (0.0, 0.0, 0.0)),
    "UTM": (1.0, (500_000.0, 5_600_000.0, 100.0)),
    "ECEF": (1.0, (4_000_000.0, 1_000_000.0, 4_900_000.0)),
    "millimetres": (1000.0, (0.0, 0.0, 0.0)),
    "kilometres": (0.001, (0.0, 0.0, 0.0)),
}
"""Factor, then shift."""


def moved(scene: Scene, folder: Path, factor: float, shift: Origin) -> Path:
    """A scene folder in other coordinates; its images are named where they are."""
    folder.mkdir(parents=True, exist_ok=True)
    pose = scene.cameras.pose.clone()
    pose[:, :, 3] = pose[:, :, 3] * factor + torch.tensor(shift, dtype=torch.float64)
    files = []
    for path in scene.paths:
        files.append(f"images/{path.name}")
        link = folder / files[-1]
        link.parent.mkdir(exist_ok=True)
        if not link.exists():
            link.symlink_to(path.resolve())
    train, test = scene.train.tolist(), scene.test.tolist()
    write_json(folder / "transforms.json", transforms(replace(scene.cameras, pose=pose), files, train=train, test=test))
    if scene.points is not None:
        parts = {"xyz": scene.points.numpy() * factor + np.array(shift)}
        if scene.seen is not None:
            parts["seen"] = scene.seen.numpy()
        np.savez(folder / "points.npz", **parts)
    return folder


def exported(run: Path, folder: Path, factor: float, shift: Origin) -> dict[str, Any]:
    """Largest errors of positions in the exported files, as shares of the scene's extent."""
    scene = open_run(run, "cpu").scene
    kinds = ["ply", "splat", "cameras"] if isinstance(scene, SplatScene) else ["cameras"]
    run_verb(["export", str(run), *kinds, "--output", str(folder)])
    extent = float((scene.cameras.pose[:, :, 3].amax(0) - scene.cameras.pose[:, :, 3].amin(0)).norm())
    found: dict[str, Any] = {"origin": list(scene.origin)}
    if isinstance(scene, SplatScene):
        local, origin = scene.gaussians.means.double().numpy(), np.array(scene.origin)
        capture = read_capture(folder / "splats.splat")
        world = capture.gaussians.means.double().numpy() + (np.array(capture.origin) - shift)
        found["splats.splat"] = float(np.abs(world - (local + (origin - shift))).max()) / extent
        vertex = np.asarray(trimesh.load_scene(folder / "splats.ply", process=False).to_geometry().vertices)  # another reader
        found["splats.ply"] = float(np.abs((vertex - shift) - (local + (origin - shift))).max()) / extent
    document = json.loads((folder / "transforms.json").read_text())
    given = np.array([frame["transform_matrix"] for frame in document["frames"]])[:, :3, 3]
    own = scene.cameras.pose[:, :, 3].numpy() + np.array(scene.origin)
    found["transforms.json"] = float(np.abs(given - own).max()) / extent
    return found


def restyled(whole: Gaussians, folder: Path, factor: float, shift: Origin) -> NDArray[np.float32]:
    """Mean colours [N 3] of a capture in other coordinates, restyled by the verb."""
    folder.mkdir(parents=True, exist_ok=True)
    given = replace(whole, means=whole.means * factor, log_scales=whole.log_scales + math.log(factor))
    write_gaussians(folder / "in.ply", given, antialiased=True, origin=shift)
    output = folder / "out.ply"
    flags = ["--references", str(REFERENCE), "--views", "8", "--cache", str(folder)]
    run_verb(["restyle", str(folder / "in.ply"), *flags, "--output", str(output)])
    return read_capture(output).gaussians.colours.clamp(0, 1).numpy()


def main(argv: list[str]) -> None:
    parser = arguments("coordinates", __doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--method", default="fprf-splats")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--moves", nargs="+", choices=MOVES, default=[*MOVES])
    parser.add_argument("--scratch", type=Path, default=Path("runs/coordinates"))
    parser.add_argument("--output", type=Path, default=RESULTS / "coordinates.json")
    own, flags = split_flags(argv)
    options = parser.parse_args(own)
    scratch = options.scratch.resolve() / options.scene.name
    scene = parse_scene(options.scene, 1, None)
    figures: dict[str, Any] = {"steps": options.steps, "flags": flags}
    first: Gaussians | None = None
    plain: NDArray[np.float32] | None = None
    for name in options.moves:
        factor, shift = MOVES[name]
        data = moved(scene, scratch / name, factor, shift)
        run = scratch / f"{name} {options.method}"
        method, _ = load_method(options.method)
        config = parse(method, ["--data", str(data), "--steps", str(options.steps), *flags], prog="coordinates", description="")
        train(replace(config, output=run), options.method, quiet=True)
        judged = evaluate(EvalConfig(run=run, images=False, device="cpu"))
        figures[name] = {"psnr": judged["psnr"], "seconds": judged["train_seconds"]}
        print(name, json.dumps(figures[name]), flush=True)
        figures[name]["share_of_extent"] = exported(run, scratch / f"{name} files", factor, shift)
        opened = open_run(run, "cpu").scene
        if isinstance(opened, SplatScene):
            first = opened.gaussians if first is None else first
            colours = restyled(first, scratch / f"{name} restyled", factor, shift)
            plain = colours if plain is None else plain
            figures[name]["restyled_rmse"] = float(np.sqrt(np.square(colours - plain).mean()))
        print(name, json.dumps(figures[name]), flush=True)
    add_entry(options.output, f"{options.scene.name} {options.method}", figures)
