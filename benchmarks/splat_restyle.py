"""Restyling captures of Gaussians: processor seconds, peak memory, and what sharp edges become.

    python -m benchmarks splat_restyle --captures plant.splat --references autumn.jpg night.jpg --output splat_restyle.json

Each capture, and made-up ones of --synthetic Gaussians, is looked at in a process of its own with one thread. `rims` is how
much the brightness that stands out at depth edges is amplified, relative to that inside of surfaces: of restyled Gaussians, and
of the picture whose pixels are mapped as their Gaussians are. Where the former is above the latter, edges glow.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .common import arguments


def main(argv: list[str]) -> None:
    parser = arguments("splat_restyle", __doc__)
    parser.add_argument("--captures", type=Path, nargs="*", default=[])
    parser.add_argument("--synthetic", type=int, nargs="*", default=[115_000, 1_000_000])
    parser.add_argument("--references", type=Path, nargs="+", required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.one:
        print(json.dumps(measured(options.one, options.references)))
        return
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for count in options.synthetic:
            path = Path(folder) / f"synthetic-{count}.splat"
            made_up(path, count)
            options.captures.append(path)
        for path in options.captures:
            words = [
                sys.executable,
                "-m",
                "benchmarks",
                "splat_restyle",
                "--one",
                str(path),
                "--output",
                "-",
                "--references",
                *map(str, options.references),
            ]
            single = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
            said = subprocess.run(words, capture_output=True, text=True, check=True, env=single).stdout
            rows.append(json.loads(said.splitlines()[-1]))
            print(rows[-1], flush=True)
            options.output.write_text(json.dumps(report(rows), indent=1) + "\n")


def report(rows: list[dict[str, Any]]) -> dict[str, Any]:
    from .report import provenance

    return {"threads": 1, "seconds": "of the processor, kernels compiled", "captures": rows, **provenance("cpu")}


def made_up(path: Path, count: int) -> None:
    """A capture that fills its views as real ones do: discs on a bumpy ball above a plane."""
    import torch

    from fprf.ops.harmonics import HARMONIC
    from fprf.splats.files import write_gaussians
    from fprf.splats.gaussians import Gaussians

    draw = torch.Generator().manual_seed(0)
    around = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    bumps = 1 + 0.15 * (around * 5).sin().prod(1, keepdim=True)
    ground = torch.rand(count, 1, generator=draw) < 0.4
    flat = (4 * torch.rand(count, 3, generator=draw) - 2) * torch.tensor([1.0, 0.0, 1.0]) + torch.tensor([0.0, 1.1, 0.0])
    means = torch.where(ground, flat, around * bumps)
    colour = torch.where(ground, torch.tensor([0.5, 0.45, 0.4]), torch.tensor([0.3, 0.5, 0.25]))
    colour = colour + 0.15 * (means * 9).sin().prod(1, keepdim=True) + 0.05 * torch.randn(count, 3, generator=draw)
    size = (6.0 / count) ** 0.5
    scales = torch.full((count, 3), size).log() + 0.3 * torch.randn(count, 3, generator=draw)
    parts = (
        means,
        torch.randn(count, 4, generator=draw),
        scales,
        torch.full((count,), 2.0),
        (colour[:, None] - 0.5) / HARMONIC,
    )
    write_gaussians(path, Gaussians(*parts))


def measured(path: Path, references: list[Path]) -> dict[str, Any]:
    import torch

    from fprf.memory import peak
    from fprf.plugins.encoders.config import SEMANTICS
    from fprf.plugins.stylizers.config import RegionToneConfig
    from fprf.splats.config import LookConfig
    from fprf.splats.files import read_capture, write_capture
    from fprf.splats.scene import look_at_capture
    from fprf.style.config import StyleConfig
    from fprf.style.files import StyleFile
    from fprf.style.restyle import apply_style

    torch.set_num_threads(1)
    start = time.process_time()
    capture = read_capture(path)
    read = time.process_time() - start
    encoder = SEMANTICS.build()
    with tempfile.TemporaryDirectory() as folder:  # compiles
        made_up(Path(folder) / "x.splat", 2000)
        look_at_capture(read_capture(Path(folder) / "x.splat").gaussians, False, encoder, LookConfig(views=1, size=(64, 48)))
    start = time.process_time()
    scene = look_at_capture(capture.gaussians, capture.antialiased, encoder, LookConfig())
    scene.found()
    looked = time.process_time() - start
    seconds: list[float] = []
    rims: dict[str, list[float]] = {}
    for reference in references:
        start = time.process_time()
        style = StyleConfig(references=(reference,), stylizer=RegionToneConfig(centred=False))
        look = apply_style(scene, StyleFile(style)).restyle
        new = scene.restyled(look).shown.harmonics
        with tempfile.TemporaryDirectory() as folder:
            write_capture(Path(folder) / path.name, capture, new)
        seconds.append(time.process_time() - start)
        rims[reference.stem] = rim_ratios(scene, look)
    return {
        "capture": f"{path.parent.name} (SOG folder)" if path.name == "meta.json" else path.name,
        "gaussians": len(capture.gaussians),
        "read_seconds": round(read, 2),
        "look_seconds": round(looked, 2),
        "style_seconds": round(sorted(seconds)[len(seconds) // 2], 2),
        "peak_mib": round((peak() or 0) / 2**20),
        "rims": rims,
    }


def rim_ratios(scene: Any, look: Any) -> list[float]:
    """Amplification of what stands out at depth edges, over that inside of surfaces: of the Gaussians, and of mapped pixels."""
    found = np.array([standing_out(scene, look, view) for view in range(0, len(scene.names), 4)])
    before, *after = found.mean(0)
    return [round(float(each[0] / before[0] / (each[1] / before[1])), 2) for each in after]


def standing_out(scene: Any, look: Any, view: int) -> list[tuple[float, float]]:
    """How much brighter than their surroundings pixels are, at depth edges and elsewhere: as captured, restyled, mapped."""
    import torch

    from fprf.rendering.cameras import pixel_grid
    from fprf.splats.photographs import camera_of
    from fprf.splats.views import draw
    from fprf.style.controls import luma

    camera = camera_of(scene.cameras, view)
    drawn, restyled = (draw(each.shown, camera, antialiased=scene.antialiased) for each in (scene, scene.restyled(look)))
    opacity = drawn.opacity[..., None]
    maps = look.parts[0].colours
    rows = torch.cat([maps.matrix, maps.bias[:, None]], 1).flatten(1)
    mean, _ = scene.paint(
        scene.cameras, view, pixel_grid(scene.cameras, view), lambda features, points: maps.membership(features) @ rows
    )
    mean = mean.view(*drawn.opacity.shape, 4, 3)
    front = drawn.image / opacity.clamp_min(1e-3)
    mapped = (front + torch.einsum("hwc,hwcd->hwd", front, mean[:, :, :3]) + mean[:, :, 3]).clamp(0, 1) * opacity
    solid = drawn.opacity.numpy() > 0.9
    depth = np.where(drawn.opacity > 0.5, drawn.depth, 1.5 * drawn.depth.max()).astype(np.float32)
    steep = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, np.ones((5, 5))) > 0.15 * float(scene.gaussians.means.std())
    away = cv2.dilate(steep.astype(np.uint8), np.ones((3, 3))) == 0
    out = []
    for image in (drawn.image, restyled.image, mapped):
        behind = (image + 0.5 * (1 - opacity)).clamp(0, 1)
        level = luma(behind.flatten(0, 1)).view(drawn.opacity.shape).numpy()
        above = np.maximum(level - cv2.GaussianBlur(level, (0, 0), 3), 0)
        out.append((float(above[solid & steep].mean()), float(above[solid & away].mean())))
    return out
