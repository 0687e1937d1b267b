"""A district of towns in cells: seconds, memory and fidelity of every verb against the size of the scene, and workers of Ray.

    python -m benchmarks large_scene [--images 2000] [--towns 16] [--parts 1 4 16] [--workers 2] [--output FILE.json]

The district (`benchmarks/town/district.py`) is written into `--work`; each part is its first towns, with four cells a town and
the same steps and Gaussians a cell. A part is trained, judged on its held-out views, flown through and written as a restyled
.ply, each by a verb in a process of its own: processor seconds, and the most memory that it held. With `--workers` the
part is trained again by Ray: how much sooner it is done, and whether its file is the same bytes.
"""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from .common import add_entry, arguments, cost_of
from .subject import town_references
from .town.district import SKY, write_district

CELLS, COARSE_STEPS, POINTS, GAUSSIANS = 4, 100, 3000, 8000
"""Cells of a town; steps of the whole for each town; Gaussians of a cell at the start and at the end."""


def main(argv: list[str]) -> None:
    parser = arguments("large_scene", __doc__)
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--towns", type=int, default=16)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 360))
    parser.add_argument("--parts", type=int, nargs="+", default=(1, 4, 16), help="towns that are trained")
    parser.add_argument("--steps", type=int, default=400, help="of a cell")
    parser.add_argument("--frames", type=int, default=60, help="of the flight")
    parser.add_argument("--workers", type=int, default=0, help="of Ray, which train each part again; 0 = none")
    parser.add_argument("--work", type=Path, help="folder of the district and the runs; by default they are thrown away")
    parser.add_argument("--output", type=Path, help="JSON file that the figures are added to")
    asked = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="fprf-district-") as made:
        work = (asked.work or Path(made)).resolve()
        district, (width, height) = work / "scene", asked.size
        workers = os.cpu_count() or 1
        write_district(district, images=asked.images, tiles=asked.towns, width=width, height=height, workers=workers)
        reference = town_references(work / "references")[0]
        for towns in asked.parts:
            row = measured(part(district, work / f"towns{towns}", towns), work, reference, towns, asked.steps, asked.frames)
            if asked.workers:
                row["ray"] = by_ray(work, towns, asked.steps, asked.workers)
                row["ray"]["speedup"] = row["train"]["seconds"] / row["ray"]["seconds"]
            add_entry(asked.output, f"{CELLS * towns} cells", row | {"load_average": os.getloadavg()[0]})


def part(district: Path, folder: Path, towns: int) -> Path:
    """The first towns of a district as a scene folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    document = json.loads((district / "transforms.json").read_text())
    count = towns * -(-len(document["frames"]) // document["towns"][1])
    document["frames"] = document["frames"][:count]
    names = {frame["file_path"] for frame in document["frames"]}
    for split in ("train_filenames", "test_filenames"):
        document[split] = [name for name in document[split] if name in names]
    (folder / "transforms.json").write_text(json.dumps(document))
    if not (folder / "images").exists():
        (folder / "images").symlink_to((district / "images").resolve())
    with np.load(district / "points.npz") as found:
        seen = found["seen"][found["seen"][:, 0] < count]
        used, number = np.unique(seen[:, 1], return_inverse=True)
        np.savez(folder / "points.npz", xyz=found["xyz"][used], rgb=found["rgb"][used], seen=np.stack([seen[:, 0], number], 1))
    return folder


def train(work: Path, run: Path, towns: int, steps: int) -> list[str]:
    """Words of the training: `--steps` covers the whole, then one cell."""
    cells, coarse = CELLS * towns, COARSE_STEPS * towns * steps // 400 + 1
    words = f"""train fprf-splats --data {work}/towns{towns} --output {run} --downscale 1 --cells {cells}
        --steps {coarse + steps} --overview {coarse / (coarse + steps)} --initial {POINTS * cells} --cap {GAUSSIANS * cells}
        --background"""
    return [*words.split(), *map(str, SKY)]


def measured(data: Path, work: Path, reference: Path, towns: int, steps: int, frames: int) -> dict[str, Any]:
    """What each verb takes, and how good the scene is."""
    run = work / f"run{towns}"
    verbs: dict[str, list[str]] = {
        "train": train(work, run, towns, steps),
        "eval": ["eval", str(run), "--no-images"],
        "flight": ["render", str(run), "--path", "interpolate", "--frames", str(frames), "--output", f"{run}.mp4"],
        "export": ["export", str(run), "ply", "--output", f"{run}.ply"],
        "style": ["export", str(run), "ply", "--styles", f"look={reference}", "--output", f"{run}-styled"],
    }
    row: dict[str, Any] = {"towns": towns, "cells": CELLS * towns}
    for name, words in verbs.items():
        row[name] = cost_of(*words)._asdict()
    found = json.loads((run / "metrics.json").read_text())
    return row | {name: found[name] for name in ("psnr", "ssim", "views", "gaussians")}


def by_ray(work: Path, towns: int, steps: int, workers: int) -> dict[str, Any]:
    """The same training by Ray's workers, and whether its export is the same file."""
    run, cluster = work / f"run{towns}", work / f"ray{towns}"
    cost = cost_of(*train(work, cluster, towns, steps), "--executor", "ray", "--executor.workers", str(workers))
    cost_of("export", cluster, "ply", "--output", f"{cluster}.ply")
    return cost._asdict() | {"same_bits": Path(f"{run}.ply").read_bytes() == Path(f"{cluster}.ply").read_bytes()}
