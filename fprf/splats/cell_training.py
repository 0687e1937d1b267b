"""Cells as tasks: idempotent, resumable, each in a folder of its own, so that they can run anywhere and again.

RUN/cells.json                               the cut: boxes, and the windows of each
RUN/cells/NN/checkpoints/, events.jsonl      as of any run
RUN/cells/NN/done.json                       what the finished cell was trained as
RUN/checkpoints/                             the union of all
"""

import hashlib
import json
import shutil
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..config import RESUMABLE
from ..datamanagers.scene import Scene
from ..errors import CheckpointError
from ..io.atomic import write_json
from ..plugins.codec import to_json
from ..training import checkpoint
from ..training.run import Run, held
from ..training.trainer import Report
from .cells import Cell, cut
from .config import GaussiansConfig
from .gaussians import Gaussians
from .training import gaussians_of, prepare, scene_of, state_of, train

__all__ = ["CellTask", "folder_of", "train_cell", "unite", "write_cells"]

_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class CellTask:
    """What a worker is told; the rest lies in the run folder."""

    root: str
    """Run folder."""
    data: str
    """Scene folder."""
    cell: int
    minutes: float | None
    """Its part of the time limit."""
    quiet: bool = False
    """Show nothing."""


def folder_of(root: Path, cell: int) -> Path:
    """Folder of a cell in a run."""
    return root / "cells" / f"{cell:02d}"


def write_cells(root: Path, scene: Scene, count: int) -> list[Cell]:
    """Cut a scene and write cells.json; cells of another cut, which could be taken for these, are removed."""
    cells = cut(scene, count)
    file = root / "cells.json"
    document = {
        "format": _FORMAT,
        "frame": cells[0].frame.tolist(),
        "cells": [
            {
                "low": [_bound(x) for x in cell.low.tolist()],
                "high": [_bound(x) for x in cell.high.tolist()],
                "windows": [[view, *window] for view, window in cell.windows.items()],
                "points": len(cell.points),
                "share": cell.share,
            }
            for cell in cells
        ],
    }
    if file.is_file() and json.loads(file.read_text()) != document:
        shutil.rmtree(root / "cells", ignore_errors=True)
    write_json(file, document)
    return cells


def _bound(value: float) -> float | None:
    """JSON knows no infinity."""
    return value if abs(value) < float("inf") else None


def train_cell(task: CellTask, report: Callable[[Report], None]) -> bool:
    """Train a cell to its end, from its newest checkpoint; False where it was finished already.

    Raises ConfigError where the images are not those of the run, DataError where another process trains the cell.
    """
    root = Path(task.root)
    folder = folder_of(root, task.cell)
    config = Run(root).load_config()[0]
    assert isinstance(config, GaussiansConfig)
    scene = scene_of(replace(config, data=Path(task.data)))
    cells = cut(scene, config.cells)
    cell = cells[task.cell]
    with held(folder):
        asked = _asked(config, scene, cell)
        done = _read_done(folder)
        if done == asked:
            return False
        mark = folder / "task.json"
        known = json.loads(mark.read_text()) if mark.is_file() else None
        if known != asked["task"]:
            shutil.rmtree(folder / "checkpoints", ignore_errors=True)
            write_json(mark, asked["task"])
        own = replace(config, minutes=task.minutes)
        train(own, prepare(own, scene, cell), Run(folder), report, spent=0.0)
        write_json(folder / "done.json", asked)
    return True


def _asked(config: GaussiansConfig, scene: Scene, cell: Cell) -> dict[str, Any]:
    """What a cell is trained as; while it stays the same, what was trained stays good."""
    tree = to_json(config)
    assert isinstance(tree, dict)
    views = list(cell.windows)
    parts = {
        "config": {name: value for name, value in tree.items() if name not in (*RESUMABLE, "executor")},
        "bounds": [cell.frame.tolist(), cell.low.tolist(), cell.high.tolist(), cell.share],
        "windows": sorted(cell.windows.items()),
        "cameras": [scene.cameras.pose[views].tolist(), scene.cameras.focal[views].tolist()],
    }
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode())
    for view in views:
        digest.update(zlib.crc32(scene.paths[view].read_bytes()).to_bytes(4, "little"))
    return {"format": _FORMAT, "task": digest.hexdigest()[:32], "steps": config.steps, "minutes": config.minutes}


def _read_done(folder: Path) -> dict[str, Any] | None:
    try:
        document: dict[str, Any] = json.loads((folder / "done.json").read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as e:
        raise CheckpointError(f"{folder / 'done.json'}: cannot be read ({e}); remove it and train again") from e
    return document


def unite(run: Run, cells: Sequence[Cell]) -> int:
    """Write the union of all finished cells as the run's checkpoint; the number of its Gaussians."""
    parts: list[Gaussians] = []
    steps, seconds, near = 0, 0.0, float("inf")
    for number, cell in enumerate(cells):
        folder = folder_of(run.root, number)
        saved, _ = checkpoint.load_latest(folder / "checkpoints")
        if saved is None or _read_done(folder) is None:
            raise CheckpointError(f"{folder}: this cell is not finished; go on with `fprf train {run.root / 'config.json'}`")
        parts.append(cell.own(gaussians_of(saved)))
        steps, seconds = steps + saved.step, seconds + saved.seconds
        near = min(near, float(saved.model["near"]))
    united = Gaussians(*(torch.cat([vars(part)[name] for part in parts]) for name in vars(parts[0])))
    nothing: dict[str, Tensor] = {"begun": torch.tensor(len(united))}
    checkpoint.write(run.checkpoints, state_of(united, near), nothing, step=steps, seconds=seconds)
    return len(united)
