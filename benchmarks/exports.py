"""Exported files, read again by other programs' means and drawn as viewers draw them, against the field's own render.

    python -m benchmarks exports RUN --references A.jpg [--output benchmarks/results/exports_NAME.json] [--picture FILE.jpg]

The views are the captured ones that nothing was trained on, as pinholes. Figures are PSNR in dB: of the whole picture, over
black where nothing is drawn, and of the pixels that are covered. Files made before are taken as they are (`--folder`). Splats
have view-dependent colours and an antialiased opacity: they are drawn by fprf's rasteriser, meshes by `rasters`.
"""

import json
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

import fprf
from fprf.api import TrainedScene
from fprf.cli.parsing import parse
from fprf.errors import UsageError
from fprf.io.images import write_image
from fprf.rendering.cameras import Cameras
from fprf.rendering.paths import pinhole
from fprf.splats.files import Capture, read_capture
from fprf.splats.photographs import camera_of
from fprf.splats.views import draw as draw_capture

from .common import report
from .rasters import draw_triangles, psnr


@dataclass(frozen=True, kw_only=True)
class ExportsConfig:
    """What is exported, and where the figures go."""

    run: Path = Path()
    """A trained run."""
    references: tuple[Path, ...] = ()
    """Photographs of one style, judged as well."""
    folder: Path | None = None
    """Where the exported files are; made there if they are absent. None = RUN/exports."""
    views: int = 4
    """Held-out views, at most."""
    fit: float = 4.0
    """Minutes of fitting the splats, where the files are made."""
    output: Path | None = None
    """JSON file for the figures."""
    picture: Path | None = None
    """A picture of the first view: the field, splats and mesh, plain and in the style."""


def main(argv: list[str]) -> None:
    config = parse(ExportsConfig(), argv, prog="python -m benchmarks exports", description=__doc__ or "", positional=("run",))
    folder = config.folder or config.run / "exports"
    if not (folder / "export.json").is_file():
        style = ["--styles", "style=" + ",".join(map(str, config.references))] if config.references else []
        words = ["export", str(config.run), "splats", "glb", "cameras", "--local", "true", "--fit", str(config.fit), *style]
        subprocess.run([sys.executable, "-m", "fprf", *words, "--output", str(folder)], check=True)
    scene = fprf.load(config.run)
    known = scene.trained.known
    if not known.test:
        raise UsageError(f"{config.run}: no held-out views to judge by")
    chosen = known.test[:: max(1, len(known.test) // config.views)][: config.views]
    cameras = [straight(known.cameras, view) for view in chosen]
    made = json.loads((folder / "export.json").read_text())
    found: dict[str, Any] = {"scene": known.name, "step": scene.trained.step, "files": sizes(folder), "export": made}
    looks = {"": scene} | ({"style": scene.stylize(list(config.references))} if config.references else {})
    rows: list[np.ndarray] = []
    for look, styled in looks.items():
        figures, row = judge(folder, look, styled, cameras, np.asarray(made["origin"]))
        found[look or "plain"] = figures
        rows.append(row)
    found["views"] = [known.names[view] for view in chosen]
    print(json.dumps({key: found[key] for key in ("plain", "style") if key in found}, indent=1))
    if config.output is not None:
        report(config.output, found)
    if config.picture is not None:
        write_image(config.picture, (np.concatenate(rows).clip(0, 1) * 255 + 0.5).astype(np.uint8))


def straight(cameras: Cameras, view: int) -> Cameras:
    """A captured view as a pinhole with its centre in the middle: what any viewer can draw."""
    width, height = (int(side) for side in cameras.size[view])
    fov = 2 * np.degrees(np.arctan(height / 2 / float(cameras.focal[view].mean())))
    return pinhole(cameras.pose[view : view + 1], width=width, height=height, fov=fov)


def judge(
    folder: Path, look: str, scene: TrainedScene, cameras: list[Cameras], origin: np.ndarray
) -> tuple[dict[str, dict[str, float]], np.ndarray]:
    """Means over the views for each kind of file, and a row of pictures of the first."""
    end = f".{look}" if look else ""
    captures = {name: read_capture(folder / f"splats{end}{name}") for name in (".ply", ".splat")}
    mesh = trimesh.load(folder / f"mesh{end}.ply", process=False)
    [glb] = trimesh.load_scene(folder / f"mesh{end}.glb", process=False).geometry.values()
    figures: dict[str, list[dict[str, float]]] = {}
    row: list[np.ndarray] = []
    for camera in cameras:
        truth = scene.render(camera).rgb.numpy().astype(float)
        pose = camera.pose[0].numpy().copy()
        pose[:, 3] -= origin
        view = (pose, float(camera.focal[0, 0]), (int(camera.size[0, 0]), int(camera.size[0, 1])))
        start = time.process_time()
        drawn = {f"splats{name}": drawn_by_fprf(capture, camera, origin) for name, capture in captures.items()}
        seconds = (time.process_time() - start) / len(captures)
        drawn["mesh.ply"] = draw_triangles(mesh.vertices, mesh.faces, mesh.visual.vertex_colors[:, :3] / 255, *view)
        drawn["mesh.glb"] = draw_triangles(glb.vertices, glb.faces, shown(glb), *view)
        for name, (image, covered) in drawn.items():
            where = np.asarray(covered) > 0.5
            figure = {"psnr": psnr(image, truth), "psnr_covered": psnr(image, truth, where), "covered": float(where.mean())}
            figures.setdefault(name, []).append(figure)
        if not row:
            print(f"{look or 'plain'}: {seconds:.1f} s a view of splats")
            row = [truth, *(drawn[name][0] for name in ("splats.ply", "mesh.ply"))]
    means = {name: {key: float(np.mean([f[key] for f in every])) for key in every[0]} for name, every in figures.items()}
    return means, np.concatenate(row, 1)


def drawn_by_fprf(capture: Capture, camera: Cameras, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Image [H W 3] and opacity [H W] of a pinhole view; a .splat cannot say that it is antialiased, and viewers are larger."""
    pose = camera.pose.clone()
    pose[0, :, 3] -= torch.from_numpy(origin)
    seen = draw_capture(capture.gaussians, camera_of(replace(camera, pose=pose), 0), antialiased=True)
    return seen.image.clamp(0, 1).double().numpy(), seen.opacity.numpy()


def shown(mesh: trimesh.Trimesh) -> np.ndarray:
    """sRGB of a glTF's vertices, whose colours are linear."""
    colour = np.asarray(mesh.visual.vertex_attributes["color"])[:, :3]
    linear = colour / np.iinfo(colour.dtype).max if colour.dtype.kind == "u" else colour
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def sizes(folder: Path) -> dict[str, int]:
    """Bytes of every file."""
    return {str(path.relative_to(folder)): path.stat().st_size for path in sorted(folder.rglob("*.*")) if path.is_file()}
