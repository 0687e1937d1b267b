"""Exported files, read again and drawn as viewers draw them, against the scene's own renders.

    python -m benchmarks exports [RUN] [--references A.jpg] [--fit MINUTES] [--output FILE.json] [--picture FILE.jpg]

`fprf export` writes splats and a mesh, plain and in one style; the views are held-out ones as pinholes.
Figures are PSNR in dB: of the whole picture, over black where nothing is drawn, and of the pixels that are
covered.
"""

import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from fprf.cli.parsing import parse
from fprf.errors import UsageError
from fprf.io.images import write_image
from fprf.rendering.cameras import Cameras
from fprf.rendering.paths import pinhole
from fprf.scenes import Scene
from fprf.splats.drawing import draw
from fprf.splats.files import read_capture
from fprf.splats.pinholes import camera_of
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.training.loading import open_run

from .common import cost_of, report, train_run
from .subject import town_references

Floats = NDArray[np.floating[Any]]
_NEAR = 0.02
"""World units before a camera in which triangles are left out."""


@dataclass(frozen=True, kw_only=True)
class ExportsConfig:
    """Scenes to export, and the file of the figures."""

    run: Path | None = None
    """A trained run; none = fprf-lite is trained on the town first."""
    steps: int = 300
    """Steps to train it."""
    references: tuple[Path, ...] = ()
    """Photographs of one style; none = a picture of another town."""
    views: int = 4
    """Held-out views, at most."""
    fit: float = 0.0
    """Minutes of fitting Gaussians to a scene of fields; 0 = as `fprf export` does."""
    output: Path | None = None
    """JSON file for the figures."""
    picture: Path | None = None
    """A picture of the first view: the scene, splats and mesh, plain and in the style."""


def main(argv: list[str]) -> None:
    """`python -m benchmarks exports [RUN] [flags]`."""
    about = __doc__ or ""
    config = parse(
        ExportsConfig(), argv, prog="python -m benchmarks exports", description=about, positional=("run",)
    )
    with tempfile.TemporaryDirectory(prefix="fprf-exports-") as made:
        folder = Path(made) / "files"
        run = config.run or train_run(Path(made) / "run", "fprf-lite", None, steps=config.steps)
        references = config.references or town_references(Path(made))[:1]
        opened = open_run(run, "cpu")
        scene = opened.scene
        known = opened.known
        if not known.test:
            raise UsageError(f"{run}: no held-out views to judge by")
        flags = ["--styles", "style=" + ",".join(map(str, references)), "--local", "true"]
        flags += ["--fit", str(config.fit)] if config.fit else []
        cost = cost_of("export", run, "ply", "splat", "glb", *flags, "--output", folder)
        sizes = {path.name: path.stat().st_size for path in sorted(folder.iterdir())}
        found: dict[str, Any] = {
            "scene": known.name,
            "step": opened.step,
            "export": cost._asdict(),
            "bytes": sizes,
        }
        moved = np.asarray(json.loads((folder / "export.json").read_text()).get("origin", (0.0, 0.0, 0.0)))
        chosen = known.test[:: max(1, len(known.test) // config.views)][: config.views]
        cameras = [straight(known.cameras, view) for view in chosen]
        look = apply_style(scene, StyleFile(StyleConfig(references=references))).restyle
        rows = []
        for name, restyle in (("plain", None), ("style", look)):
            found[name], row = judge(
                folder, "" if restyle is None else ".style", scene, restyle, cameras, moved
            )
            rows.append(np.concatenate(row, 1))
        print(json.dumps(found, indent=1))
        report(config.output, found)
        if config.picture is not None:
            write_image(config.picture, (np.concatenate(rows).clip(0, 1) * 255 + 0.5).astype(np.uint8))


def straight(cameras: Cameras, view: int) -> Cameras:
    """A captured view as a pinhole with its centre in the middle: what any viewer can draw."""
    width, height = (int(side) for side in cameras.size[view])
    fov = 2 * np.degrees(np.arctan(height / 2 / float(cameras.focal[view].mean())))
    return pinhole(cameras.pose[view : view + 1], width=width, height=height, fov=float(fov))


def judge(
    folder: Path, end: str, scene: Scene, look: Restyle | None, cameras: list[Cameras], origin: Floats
) -> tuple[dict[str, dict[str, float]], list[Floats]]:
    """Means over the views for each file of a look, and pictures of the first view: the scene's, then the
    files'.
    """
    captures = {
        path.name: read_capture(path) for path in (folder / f"splats{end}.ply", folder / f"splats{end}.splat")
    }
    [mesh] = trimesh.load_scene(folder / f"mesh{end}.glb", process=False).geometry.values()
    colour = np.asarray(mesh.visual.vertex_attributes["color"])[:, :3]
    linear = colour / np.iinfo(colour.dtype).max if colour.dtype.kind == "u" else colour
    shown = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
    figures: dict[str, list[dict[str, float]]] = {}
    pictures: list[Floats] = []
    for camera in cameras:
        truth = scene.cached(camera, 0).restyled(look).rgb.numpy().astype(float)
        pose = camera.pose.clone()
        pose[0, :, 3] -= torch.from_numpy(origin)
        local = replace(camera, pose=pose)
        drawn: dict[str, tuple[Floats, Floats]] = {}
        for name, capture in captures.items():
            seen = draw(capture.gaussians, camera_of(local, 0), antialiased=capture.antialiased)
            drawn[name] = seen.image.clamp(0, 1).double().numpy(), seen.opacity.numpy()
        drawn[f"mesh{end}.glb"] = draw_triangles(
            np.asarray(mesh.vertices), np.asarray(mesh.faces), shown, local
        )
        for name, (image, covered) in drawn.items():
            where = covered > 0.5
            figure = {"psnr": psnr(image - truth), "psnr_covered": psnr((image - truth)[where])}
            figures.setdefault(name, []).append(figure | {"covered": float(where.mean())})
        pictures = pictures or [truth, *(image for image, _ in drawn.values())]
    means = {
        name: {key: float(np.mean([f[key] for f in every])) for key in every[0]}
        for name, every in figures.items()
    }
    return means, pictures


def psnr(error: Floats) -> float:
    """Of differences of colours in [0, 1], in dB; at most 99."""
    return float(-10 * np.log10(max(float(np.square(error).mean()) if error.size else 0.0, 10**-9.9)))


def draw_triangles(
    point: Floats, face: NDArray[np.integer[Any]], colour: Floats, camera: Cameras
) -> tuple[Floats, Floats]:
    """Image [H W 3] and where it is covered [H W], by a pinhole: colours of vertices are interpolated in the
    world.

    Triangles are seen from both sides; behind them is black.
    """
    width, height = (int(side) for side in camera.size[0])
    pose = camera.pose[0].numpy()
    local = (point - pose[:, 3]) @ (pose[:, :3] * [1, -1, -1])
    depth = local[:, 2]
    pixel = (
        float(camera.focal[0, 0]) * local[:, :2] / np.where(depth > 0, depth, 1)[:, None]
        + np.array([width, height]) / 2
    )
    face = face[(depth[face] > _NEAR).all(1)]
    low = np.ceil(pixel[face].min(1) - 0.5).clip(0, (width, height)).astype(int)
    high = np.floor(pixel[face].max(1) - 0.5).clip(-1, (width - 1, height - 1)).astype(int)
    reach = (high - low + 1).max(1)
    some = ((high - low) >= 0).all(1)
    where = [np.zeros(0, int)]
    far = [np.zeros(0)]
    shade = [np.zeros((0, 3))]
    # Triangles of like size share a grid of candidate pixels.
    for side in (2**k for k in range(12)):
        group = np.flatnonzero(some & (reach <= side) & (reach > side // 2))
        for chunk in np.array_split(group, 1 + len(group) * side**2 // 2_000_000):
            at = low[chunk][:, None] + np.stack(np.meshgrid(*(np.arange(side),) * 2), -1).reshape(-1, 2)
            share = _barycentric(at + 0.5, pixel[face[chunk]])
            row, cell = np.nonzero((share >= 0).all(-1) & (at <= high[chunk][:, None]).all(-1))
            # Straight in 1 / depth and colour / depth, as perspective is.
            part = share[row, cell] / depth[face[chunk]][row]
            inverse = part.sum(1)
            where.append(at[row, cell, 1] * width + at[row, cell, 0])
            far.append(1 / inverse)
            shade.append((part[:, :, None] * colour[face[chunk]][row]).sum(1) / inverse[:, None])
    # The nearest candidate of each pixel that has one.
    every = np.concatenate(where)
    z = np.concatenate(far)
    tint = np.concatenate(shade)
    order = np.lexsort((z, every))
    picked, first = np.unique(every[order], return_index=True)
    image = np.zeros((width * height, 3))
    covered = np.zeros(width * height)
    image[picked] = tint[order[first]]
    covered[picked] = 1.0
    return image.reshape(height, width, 3), covered.reshape(height, width)


def _barycentric(at: Floats, corner: Floats) -> Floats:
    """Shares [F P 3] of the corners [F 3 2] at places [F P 2]; negative outside, also for triangles without
    area.
    """
    a, b, c = (corner[:, None, k] for k in range(3))

    def area(u: Floats, v: Floats, w: Floats) -> Floats:
        return (v[..., 0] - u[..., 0]) * (w[..., 1] - u[..., 1]) - (v[..., 1] - u[..., 1]) * (
            w[..., 0] - u[..., 0]
        )

    whole = area(a, b, c)
    parts = np.stack([area(b, c, at), area(c, a, at), area(a, b, at)], -1)
    flat = np.abs(whole) < 1e-12
    return np.where(flat[..., None], -1.0, parts / np.where(flat, 1.0, whole)[..., None])
