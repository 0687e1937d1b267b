"""Restyling captures of Gaussians: processor seconds and peak memory.

    python -m benchmarks splat_restyle [--captures plant.splat] [--references autumn.jpg night.jpg] [--output FILE.json]

Each capture, and made-up ones of --synthetic Gaussians, is looked at in a process of its own with one thread.
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

import torch

from fprf.memory import peak
from fprf.ops.harmonics import HARMONIC
from fprf.plugins.encoders.config import SEMANTICS
from fprf.plugins.stylizers.config import RegionToneConfig
from fprf.splats.captures import look_at_capture
from fprf.splats.config import LookConfig
from fprf.splats.files import read_capture, write_capture, write_gaussians
from fprf.splats.gaussians import Gaussians
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style

from .common import arguments, report
from .subject import town_references


def main(argv: list[str]) -> None:
    parser = arguments("splat_restyle", __doc__)
    parser.add_argument("--captures", type=Path, nargs="*", default=[])
    parser.add_argument("--synthetic", type=int, nargs="*", default=[115_000, 1_000_000])
    parser.add_argument(
        "--references", type=Path, nargs="+", help="photographs; by default pictures of towns"
    )
    parser.add_argument("--output", type=Path)
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.one:
        print(json.dumps(measured(options.one, options.references)))
        return
    rows = []
    single = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        references = options.references or town_references(Path(folder))
        for count in options.synthetic:
            options.captures.append(Path(folder) / f"synthetic-{count}.splat")
            made_up(options.captures[-1], count)
        for path in options.captures:
            words = [
                sys.executable,
                "-m",
                "benchmarks",
                "splat_restyle",
                "--one",
                path,
                "--references",
                *references,
            ]
            said = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True, env=single).stdout
            rows.append(json.loads(said.splitlines()[-1]))
            print(rows[-1], flush=True)
    report(options.output, {"threads": 1, "seconds": "of the processor, kernels compiled", "captures": rows})


def made_up(path: Path, count: int) -> None:
    """A capture that fills its views as real ones do: discs on a bumpy ball above a plane."""
    draw = torch.Generator().manual_seed(0)
    around = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    bumps = 1 + 0.15 * (around * 5).sin().prod(1, keepdim=True)
    ground = torch.rand(count, 1, generator=draw) < 0.4
    flat = (4 * torch.rand(count, 3, generator=draw) - 2) * torch.tensor([1.0, 0.0, 1.0]) + torch.tensor(
        [0.0, 1.1, 0.0]
    )
    means = torch.where(ground, flat, around * bumps)
    colour = torch.where(ground, torch.tensor([0.5, 0.45, 0.4]), torch.tensor([0.3, 0.5, 0.25]))
    colour = (
        colour + 0.15 * (means * 9).sin().prod(1, keepdim=True) + 0.05 * torch.randn(count, 3, generator=draw)
    )
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
    torch.set_num_threads(1)
    start = time.process_time()
    capture = read_capture(path)
    read = time.process_time() - start
    encoder = SEMANTICS.build()
    with tempfile.TemporaryDirectory() as folder:  # compiles
        made_up(Path(folder) / "x.splat", 2000)
        look_at_capture(
            read_capture(Path(folder) / "x.splat").gaussians,
            False,
            encoder,
            LookConfig(views=1, size=(64, 48)),
        )
    start = time.process_time()
    scene = look_at_capture(capture.gaussians, capture.antialiased, encoder, LookConfig())
    scene.found()
    looked = time.process_time() - start
    seconds: list[float] = []
    for reference in references:
        start = time.process_time()
        style = StyleConfig(references=(reference,), stylizer=RegionToneConfig(centred=False))
        look = apply_style(scene, StyleFile(style)).restyle
        new = scene.restyled(look).shown.harmonics
        with tempfile.TemporaryDirectory() as folder:
            write_capture(Path(folder) / path.name, capture, new)
        seconds.append(time.process_time() - start)
    return {
        "capture": f"{path.parent.name} (SOG folder)" if path.name == "meta.json" else path.name,
        "gaussians": len(capture.gaussians),
        "read_seconds": round(read, 2),
        "look_seconds": round(looked, 2),
        "style_seconds": round(sorted(seconds)[len(seconds) // 2], 2),
        "peak_mib": round((peak() or 0) / 2**20),
    }
