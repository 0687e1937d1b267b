"""A district of thousands of images, written and trained in cells: seconds and memory of a cell against the number of cells.

    python -m benchmarks district WORK [--images 2000] [--towns 16] [--parts 1 4 16] [--output FILE.json]

Images and cameras are those of `district_scene.py`; they are kept in WORK. Each part is the district's first towns with four
cells a town: the whole is trained coarsely, then `--sampled` of its cells, each in a process of its own. All parts have as many
steps a town and a cell, at full size. Seconds are those of the processor; set-up is what a cell takes before its first step.
One cell is killed half-way and gone on with; its Gaussians are compared with those of an undisturbed one. The flight draws
views all over the coarse scene from levels of detail in files; its error is that against all Gaussians.
"""

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np

from .common import RESULTS, add_entry, arguments
from .district_scene import SKY, write_district

CELLS, STEPS, COARSE_STEPS, GAUSSIANS, POINTS = 4, 400, 100, 8000, 3000
"""Cells of a town; steps of a cell; steps of the whole for each town; Gaussians of a cell at the end and at the start."""
Result = TypeVar("Result")


def part(district: Path, folder: Path, towns: int) -> None:
    """The first towns of a district as a scene folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    document = json.loads((district / "transforms.json").read_text())
    count = towns * -(-len(document["frames"]) // document["towns"][1])
    names = {frame["file_path"] for frame in document["frames"][:count]}
    document["frames"] = document["frames"][:count]
    for split in ("train_filenames", "test_filenames"):
        document[split] = [name for name in document[split] if name in names]
    (folder / "transforms.json").write_text(json.dumps(document))
    if not (folder / "images").exists():
        (folder / "images").symlink_to((district / "images").resolve())
    with np.load(district / "points.npz") as found:
        seen = found["seen"][found["seen"][:, 0] < count]
        used, number = np.unique(seen[:, 1], return_inverse=True)
        seen = np.stack([seen[:, 0], number], 1)
        with (folder / "points.npz").open("wb") as file:
            np.savez(file, xyz=found["xyz"][used], rgb=found["rgb"][used], seen=seen)


def apart(function: Callable[..., Result], *args: Any) -> Result:
    """Call in a process of its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *args).result()


def begin(data: Path, run: Path, towns: int) -> dict[str, Any]:
    """Cut the scene and train the whole of it coarsely."""
    import torch

    from fprf.datamanagers.images import load_images
    from fprf.splats.cells import Cells, open_cell
    from fprf.splats.config import GaussiansConfig
    from fprf.splats.training import lit_facts
    from fprf.training.prepare import read_scene
    from fprf.training.run import Run
    from fprf.training.tasks import WHOLE, Task, train_part

    from .blocks import peak_mib

    torch.set_num_threads(1)
    cells, coarse = CELLS * towns, COARSE_STEPS * towns
    # `--steps` covers the whole, then one cell.
    config = GaussiansConfig(
        data=data, downscale=1, cells=cells, steps=coarse + STEPS, overview=coarse / (coarse + STEPS), coarse=0.0,
        initial=POINTS * cells, cap=GAUSSIANS * cells, background=SKY, checkpoint_minutes=0.02,
    )  # fmt: skip
    start = time.process_time()
    scene, folder = read_scene(config), Run(run)
    run.mkdir(parents=True, exist_ok=True)
    facts = lit_facts(config, scene, lambda view: load_images(scene, config.background, [view])[0])
    folder.save_config(config, "fprf-splats")
    folder.save_known(scene, data, facts)
    lit_after = time.process_time() - start
    found = Cells(config, scene, facts).write(folder)
    cut_after = time.process_time() - start
    whole = Task(root=str(run), data=str(data), part=WHOLE, minutes=None, quiet=True)
    train_part(open_cell(whole), lambda event: None)
    return {
        "images": len(scene.paths),
        "tones": bool(facts.exposure),
        "exposures_seconds": lit_after,
        "cut_seconds": cut_after - lit_after,
        "whole_seconds": time.process_time() - start - cut_after,
        "peak_rss_mib": peak_mib(),
        "windows": [len(cell.windows) for cell in found],
        "pixels": [sum(width * height for _, _, width, height in cell.windows.values()) for cell in found],
    }


def one_cell(data: Path, run: Path, cell: int) -> dict[str, Any]:
    """Train one cell to its end; its seconds of set-up and of each step."""
    import torch

    from fprf.splats import training
    from fprf.splats.cells import folder_of, open_cell
    from fprf.training import checkpoint
    from fprf.training.tasks import Task, train_part

    from .blocks import peak_mib

    torch.set_num_threads(1)
    vars(training)["time"] = SimpleNamespace(perf_counter=time.process_time)
    start = time.process_time()
    task = Task(root=str(run), data=str(data), part=cell, minutes=None, quiet=True)
    train_part(open_cell(task), lambda event: None)
    seconds = time.process_time() - start
    saved, _ = checkpoint.load_latest(folder_of(run, cell) / "checkpoints")
    assert saved is not None
    digest = hashlib.sha256(b"".join(tensor.numpy().tobytes() for tensor in saved.model.values())).hexdigest()
    return {
        "cell": cell,
        "seconds": seconds,
        "setup_seconds": seconds - saved.seconds,
        "seconds_per_step": saved.seconds / max(saved.step, 1),
        "gaussians": len(saved.model["means"]),
        "peak_rss_mib": peak_mib(),
        "digest": digest,
    }


def killed(data: Path, run: Path, cell: int) -> str:
    """Train a cell that is killed once it has a checkpoint; the digest of what it is in the end."""
    from fprf.splats.cells import folder_of

    shutil.rmtree(folder_of(run, cell))
    process = multiprocessing.get_context("spawn").Process(target=one_cell, args=(data, run, cell))
    process.start()
    while process.is_alive() and not [*folder_of(run, cell).glob("checkpoints/step-*/manifest.json")]:
        time.sleep(0.05)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert not (folder_of(run, cell) / "done.json").exists(), "the cell was finished before it could be killed"
    digest: str = apart(one_cell, data, run, cell)["digest"]
    return digest


def write_for_flight(run: Path) -> dict[str, Any]:
    """Write levels of detail of the whole scene."""
    from fprf.splats.cells import load_overview
    from fprf.splats.gaussians import from_tensors
    from fprf.splats.levels import write_levels

    from .blocks import peak_mib

    saved = load_overview(run)
    start = time.process_time()
    write_levels(run / "levels", from_tensors(saved.model), "flight")
    count = len(saved.model["means"])
    return {
        "gaussians": count,
        "microseconds_a_gaussian": 1e6 * (time.process_time() - start) / count,
        "peak_rss_mib": peak_mib(),
    }


def flight(run: Path, frames: int, pixels: float, everything: bool) -> dict[str, Any]:
    """Draw views all over the scene; with `everything` all Gaussians as well, for the error."""
    import torch

    from fprf.splats.cells import load_overview
    from fprf.splats.gaussians import from_tensors
    from fprf.splats.levels import open_levels
    from fprf.splats.photographs import cover
    from fprf.splats.views import draw
    from fprf.training.run import Run

    from .blocks import peak_mib

    saved = load_overview(run)
    levels = open_levels(run / "levels", "flight")
    assert levels is not None
    cameras, near = Run(run).load_known().cameras, float(saved.model["near"])
    before, wall, processor, counts, errors = peak_mib(), [], [], [], []
    for turn, view in enumerate(np.linspace(0, len(cameras) - 1, frames).round().astype(int).tolist()):
        camera = cover(cameras, view, near)[0]
        start = time.perf_counter(), time.process_time()
        shown = levels.select(camera, pixels)
        image = draw(shown, camera, antialiased=True, background=SKY).image.clamp(0, 1)
        if turn:  # kernels are loaded with the first
            wall.append(time.perf_counter() - start[0])
            processor.append(time.process_time() - start[1])
            counts.append(len(shown))
        if everything:
            full = draw(from_tensors(saved.model), camera, antialiased=True, background=SKY).image.clamp(0, 1)
            errors.append(float((full - image).square().mean()))
    if everything:
        return {"rms_error_255": 255 * float(np.mean(errors)) ** 0.5, "worst_rms_error_255": 255 * max(errors) ** 0.5}
    return {
        "pixels": pixels,
        "frames": frames,
        "threads": torch.get_num_threads(),
        "median_seconds": float(np.median(wall)),
        "median_processor_seconds": float(np.median(processor)),
        "largest_processor_seconds": max(processor),
        "mean_gaussians": float(np.mean(counts)),
        "rss_before_mib": before,
        "peak_rss_mib": peak_mib(),
    }


def main(argv: list[str]) -> None:
    parser = arguments("district", __doc__)
    parser.add_argument("work", type=Path)
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--towns", type=int, default=16)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 360))
    parser.add_argument("--workers", type=int, default=2, help="processes that write images")
    parser.add_argument("--parts", type=int, nargs="+", default=(1, 4, 16), help="towns that are trained")
    parser.add_argument("--sampled", type=int, default=4, help="cells that are trained, spread over all")
    parser.add_argument("--frames", type=int, default=60, help="of the flight")
    parser.add_argument("--merged", type=float, default=1.0, help="pixels within which the flight merges Gaussians")
    parser.add_argument("--output", type=Path, default=RESULTS / "district.json")
    args = parser.parse_args(argv)
    district, (width, height) = args.work.resolve() / "scene", args.size
    write_district(district, images=args.images, tiles=args.towns, width=width, height=height, workers=args.workers)
    for towns in args.parts:
        data, run = args.work.resolve() / f"towns{towns}", args.work.resolve() / f"run{towns}"
        part(district, data, towns)
        shutil.rmtree(run, ignore_errors=True)
        row: dict[str, Any] = {"towns": towns, "cells": CELLS * towns, "whole": apart(begin, data, run, towns)}
        cells = np.linspace(0, CELLS * towns - 1, min(args.sampled, CELLS * towns)).round().astype(int).tolist()
        row["sampled"] = [apart(one_cell, data, run, cell) for cell in cells]
        for name in ("seconds", "setup_seconds", "seconds_per_step", "peak_rss_mib", "gaussians"):
            row[f"mean_{name}"] = float(np.mean([each[name] for each in row["sampled"]]))
        row["killed_is_the_same"] = killed(data, run, cells[0]) == row["sampled"][0]["digest"]
        row["levels"] = apart(write_for_flight, run)
        row["flight"] = apart(flight, run, args.frames, args.merged, False)
        row["flight"] |= apart(flight, run, min(args.frames, 20), args.merged, True)
        row["load_average"] = os.getloadavg()[0]
        print(json.dumps(row), flush=True)
        add_entry(args.output, f"{CELLS * towns} cells", row)
