"""A style on large scenes of Gaussians: seconds and memory against their number.

    python -m benchmarks district_style RUN PHOTOGRAPH [--copies 1 8] [--output FILE.json]

RUN is of Gaussians; its copies lie side by side, and each size is a run of its own in a temporary folder. `regions` are found
anew. Then, with what was found: the style is made and all Gaussians are recoloured; they are written to a .ply, which is killed
half-way, gone on with, and compared with one that was not; a flight over the scene is drawn in the style from levels of detail.
Seconds are the processor's, each part has a process of its own, and its memory is that of the process.
"""

import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fprf.splats.gaussians import from_tensors, tensors_of
from fprf.splats.loading import open_gaussians
from fprf.training import checkpoint
from fprf.training.quality import QualityConfig
from fprf.training.run import Run

from .blocks import peak_mib
from .common import RESULTS, add_entry, arguments
from .district import apart

_STEP = 1
"""Of the copies' checkpoints."""


def tile(source: Path, run: Path, copies: int) -> int:
    """Write a run of copies side by side along x; the number of Gaussians."""
    saved, _ = checkpoint.load_latest(source / "checkpoints", verify=False)
    assert saved is not None
    run.mkdir()
    for name in ("config.json", "scene.json"):
        shutil.copy(source / name, run / name)
    gaussians = from_tensors(saved.model)
    low, high = gaussians.means[:, 0].sort().values[[len(gaussians) // 50, -(len(gaussians) // 50) - 1]]
    shift = torch.arange(copies).repeat_interleave(len(gaussians)) * (high - low)
    state = {name: torch.cat([part] * copies) for name, part in tensors_of(gaussians, 0.0).items() if name != "near"}
    state["means"][:, 0] += shift
    near = saved.model["near"]
    tones = {name: part for name, part in saved.optimizer.items() if name.startswith("tones.")}
    checkpoint.write(run / "checkpoints", state | {"near": near}, tones, step=_STEP, seconds=saved.seconds)
    return len(shift)


def _open(run: Path) -> Any:
    torch.set_num_threads(1)
    return open_gaussians(Run(run), Run(run).load_config()[0], "cpu", QualityConfig(quality="standard")).scene


def find_regions(run: Path) -> dict[str, float]:
    """Find and keep the semantics."""
    scene, start = _open(run), time.process_time()
    scene.found()
    return {"seconds": time.process_time() - start, "peak_rss_mib": peak_mib()}


def _styled(run: Path, photograph: Path) -> tuple[Any, Any]:
    from fprf.style.config import StyleConfig
    from fprf.style.files import StyleFile
    from fprf.style.restyle import apply_style

    scene = _open(run)
    scene.found()
    look = apply_style(scene, StyleFile(StyleConfig(references=(photograph,)))).restyle
    return scene.restyled(look), look


def write(run: Path, photograph: Path, path: Path) -> dict[str, float]:
    """Recolour all Gaussians, a part in memory at a time; then write them as `fprf export` does."""
    from fprf.splats.files import write_ply_parts

    start = time.process_time()
    scene, look = _styled(run, photograph)
    made, count, before = time.process_time() - start, len(scene.gaussians), peak_mib()
    scene.part(slice(0, 1 << 15))  # loads kernels
    start = time.process_time()
    for row in range(0, count, 1 << 15):
        scene.part(slice(row, min(row + (1 << 15), count)))
    recoloured = time.process_time() - start
    start = time.process_time()
    write_ply_parts(path, scene.part, count, look.digest, antialiased=True)
    return {
        "style_seconds": made,
        "recolour_microseconds_a_gaussian": 1e6 * recoloured / count,
        "file_microseconds_a_gaussian": 1e6 * (time.process_time() - start) / count,
        "rss_before_mib": before,
        "peak_rss_mib": peak_mib(),
    }


def killed(run: Path, photograph: Path, path: Path) -> float:
    """Write a file, but kill the process half-way; the share of the rows that was there, to be gone on with."""
    process = multiprocessing.get_context("spawn").Process(target=write, args=(run, photograph, path))
    process.start()
    size = 4 * 3 * int(1e6)  # a tenth of the rows of a million
    there = 0
    while process.is_alive() and there < size:
        there = max((file.stat().st_size for file in path.parent.glob(f".{path.stem}.*/rows")), default=0)
        time.sleep(0.005)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not path.exists(), "the file was whole before its writer could be killed"
    return there


def flight(run: Path, photograph: Path, frames: int) -> dict[str, float]:
    """Draw views all over the scene in the style; all levels were written before."""
    scene, _ = _styled(run, photograph)
    seconds, before = [], peak_mib()
    views = np.linspace(0, len(scene.names) - 1, frames).round().astype(int).tolist()
    for _ in range(2):
        for view in views:
            start = time.process_time()
            scene.render(scene.cameras, view)
            seconds.append(time.process_time() - start)
    return {
        "frames": frames,
        "first_seconds": seconds[0],
        "median_seconds": float(np.median(seconds[1:frames])),
        "largest_seconds": max(seconds[1:frames]),
        "median_seconds_again": float(np.median(seconds[frames:])),
        "rss_before_mib": before,
        "peak_rss_mib": peak_mib(),
    }


def plain(run: Path) -> dict[str, float]:
    """Draw one view as it is: levels are written where there are none."""
    scene, start = _open(run), time.process_time()
    scene.render(scene.cameras, 0)
    seconds = time.process_time() - start
    return {"microseconds_a_gaussian": 1e6 * seconds / len(scene.gaussians), "peak_rss_mib": peak_mib()}


def same(first: Path, second: Path) -> bool:
    a, b = (np.memmap(path, np.uint8, mode="r") for path in (first, second))
    part = 1 << 26
    return len(a) == len(b) and all(bool((a[k : k + part] == b[k : k + part]).all()) for k in range(0, len(a), part))


def main(argv: list[str]) -> None:
    parser = arguments("district_style", __doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("photograph", type=Path)
    parser.add_argument("--copies", type=int, nargs="+", default=(1, 8))
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--output", type=Path, default=RESULTS / "district_style.json")
    args = parser.parse_args(argv)
    for copies in args.copies:
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            whole, again = Path(folder) / "whole.ply", Path(folder) / "again.ply"
            row: dict[str, Any] = {"gaussians": apart(tile, args.run.resolve(), run, copies)}
            row["regions"] = apart(find_regions, run)
            row["levels"] = apart(plain, run)
            row["file"] = apart(write, run, args.photograph.resolve(), whole)
            row["killed_at_bytes"] = killed(run, args.photograph.resolve(), again)
            apart(write, run, args.photograph.resolve(), again)
            row["killed_is_the_same"] = same(whole, again)
            row["flight"] = apart(flight, run, args.photograph.resolve(), args.frames)
            row["load_average"] = os.getloadavg()[0]
        print(row, flush=True)
        add_entry(args.output, f"{copies} copies", row)
