"""Cells as tasks: idempotent, resumable, each in a folder of its own, so that they can run anywhere and again.

The whole scene is trained first, on photographs of half the size, for most of the schedule. Each cell goes on from there, with
the poses that were refined there.

RUN/cells.json                               the cut: boxes, and the windows of each
RUN/views.json                               where images and masks lie, so that no cell reads the whole scene folder again
RUN/overview/checkpoints/, done.json         the whole scene, which cells start from
RUN/cells/NN/checkpoints/, events.jsonl      a cell, as of any run
RUN/cells/NN/done.json                       what the finished cell was trained as
RUN/checkpoints/                             the union of all cells
"""

import hashlib
import json
import math
import shutil
import time
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..blocks import partition
from ..blocks.partition import bisect_sightings
from ..config import RESUMABLE
from ..datamanagers.images import load_images
from ..datamanagers.scene import Scene
from ..errors import CheckpointError
from ..interfaces import Partition, State
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..ops.rasterise_training import compile_beside
from ..plugins.codec import from_json, to_json
from ..progress import Display
from ..training import checkpoint
from ..training.camera_optimizers import Tones
from ..training.driver import Report, Schedule, learn, reporter
from ..training.model import Facts
from ..training.prepare import read_scene
from ..training.run import Run, begin, held, known_of
from ..types import Cell
from .cells import crop, scene_in_windows, shown_in_windows
from .config import GaussiansConfig
from .gaussians import Gaussians, from_tensors, tensors_of
from .learner import MOVES, GaussianLearner, Part
from .loading import refined
from .photographs import load_photographs, load_skies, make_levels
from .training import build, limit_widths, lit_facts, reach_of

_FORMAT, _VIEWS, _WRITTEN = 6, "views.json", "train again to write it"
OVERVIEW = "overview"
"""Folder of the whole scene in a run."""
_MOMENTS = "first", "second", "weight"
_PIXELS, _SMALLEST = 16_000_000, 4
"""Pixels of all photographs that the whole scene is trained on, at most; how far they are reduced before some are left out."""
_RATE = 0.5
"""Factor of the learning rates in cells, whose windows are seen more often than the photographs of the whole scene."""
_VISITS = 10
"""Times that the whole scene sees each of them, at least, however few `steps` there are: cells do not make up for fewer."""


@dataclass(frozen=True, kw_only=True)
class CellTask:
    """Instructions for a worker; the rest lies in the run folder."""

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


class Cells(Partition):
    """A scene whose parts of space are trained apart: the whole coarsely, then the cells, largest windows first."""

    def __init__(self, config: GaussiansConfig, scene: Scene, saved: Facts | None) -> None:
        self.config, self.scene = config, scene
        self.compiling = compile_beside((config.degree + 1) ** 2)
        self._facts = saved or lit_facts(config, scene, lambda view: load_images(scene, config.background, [view])[0])

    @property
    def facts(self) -> Facts:
        return self._facts

    def train(self, run: Run, display: Display, *, spent: float) -> None:
        """Train the whole scene, then all cells, and write their union."""
        config, scene, begun = self.config, self.scene, time.perf_counter()
        assert config.data is not None  # the scene was read from there
        for process in self.compiling:
            process.wait()
        cells = write_cells(run.root, scene, config.data, config.cells)
        pixels = [sum(width * height for _, _, width, height in cell.windows.values()) for cell in cells]
        whole = int(scene.cameras.size[scene.train].prod(1).sum())
        display.say(f"{len(cells)} cells, whose windows are {sum(pixels) / whole:.2f} times the photographs")
        report = reporter(display, run, "whole scene")
        if not train_overview(run.root, config, scene, report, spent=spent + time.perf_counter() - begun):
            display.say("the whole scene is trained already")
        root, data = str(run.root.resolve()), str(config.data.resolve() if config.data.exists() else config.data)
        order = sorted(range(len(cells)), key=lambda cell: -pixels[cell])
        minutes = None
        if config.minutes is not None:
            passed = (spent + time.perf_counter() - begun) / 60
            minutes = max(config.minutes - passed, 0.05 * config.minutes) / len(cells)
        tasks = [CellTask(root=root, data=data, cell=cell, minutes=minutes, quiet=display.quiet) for cell in order]
        config.executor.on("cpu").build().map(run_cell, tasks)
        display.say(f"{unite(run.root, cells)} Gaussians")


def run_cell(task: CellTask) -> None:
    """Train one cell, here or on a worker, and show how it goes."""
    name = f"cell {task.cell:02d}"
    with Display(quiet=task.quiet) as display:
        if not train_cell(task, reporter(display, Run(folder_of(Path(task.root), task.cell)), name)):
            display.say(f"{name} is finished already")


def _load_overview(root: Path) -> checkpoint.Saved:
    """The whole scene, mapped: of large ones a cell reads a part. Raises CheckpointError where it was not trained."""
    folder = root / OVERVIEW / "checkpoints"
    saved, _ = checkpoint.load_latest(folder, verify=False)
    if saved is None:
        raise CheckpointError(f"{folder}: no checkpoint to start a cell from; train the run again")
    return saved


def write_cells(root: Path, scene: Scene, data: Path, count: int) -> list[Cell]:
    """Cut the scene of a folder `data`, and write cells.json and views.json.

    Cells of another cut, which could be taken for these, are removed.
    """
    cells = bisect_sightings(scene, count)
    if partition.write_cells(root / "cells.json", cells):
        shutil.rmtree(root / "cells", ignore_errors=True)
    (root / _VIEWS).unlink(missing_ok=True)
    if all(path is None or path.is_relative_to(data) for path in (*scene.paths, *scene.masks, *scene.sky_masks)):
        files = {"paths": scene.paths, "masks": scene.masks, "sky_masks": scene.sky_masks}
        write_json(
            root / _VIEWS,
            {name: [path and path.relative_to(data).as_posix() for path in paths] for name, paths in files.items()},
        )
    return cells


def _read_views(root: Path, config: GaussiansConfig, data: Path) -> Scene:
    """The views of a run's scene with their images in the folder `data`; parsed where the run does not list them.

    Raises CheckpointError where the list cannot be read.
    """
    file, known = root / _VIEWS, Run(root).load_known()
    if not file.is_file():
        return read_scene(replace(config, data=data), known.facts)
    with open_json(file, _WRITTEN) as document:
        paths = from_json(document["paths"], tuple[str, ...], path="paths")
        masks = from_json(document["masks"], tuple[str | None, ...], path="masks")
        skies = from_json(document.get("sky_masks", []), tuple[str | None, ...], path="sky_masks")  # older runs name none
        if len(paths) != len(known.cameras) or not {len(masks), len(skies)} <= {0, len(paths)}:
            raise ValueError(f"{len(paths)} images, {len(masks)} and {len(skies)} masks for {len(known.cameras)} cameras")
    train, test = torch.tensor(known.train), torch.tensor(known.test, dtype=torch.int64)
    return Scene(
        name=known.name,
        paths=tuple(data / name for name in paths),
        cameras=known.cameras,
        train=train,
        test=test,
        masks=tuple(None if name is None else data / name for name in masks),
        sky_masks=tuple(None if name is None else data / name for name in skies),
        origin=known.facts.origin,
    )


def read_cells(root: Path) -> list[Cell]:
    """The cells of a run. Raises CheckpointError where the file cannot be read."""
    return partition.read_cells(root / "cells.json")


def train_overview(
    root: Path, config: GaussiansConfig, scene: Scene, report: Callable[[Report], None], *, spent: float
) -> bool:
    """Train the whole scene on photographs of half the size, for its part of the schedule; False where that was done already.

    Its rates fall as those of one piece do, so that cells start from the best there is. What is finished stays when a run is
    gone on with for more steps or minutes. Raises CheckpointError where it is damaged.
    """
    folder = root / OVERVIEW
    task = _task(config, scene, scene.train.tolist())
    done, kept = _read_done(folder), checkpoint.steps(folder / "checkpoints")
    if done is not None and done.get("task") == task and kept:
        try:
            checkpoint.load(folder / "checkpoints", kept[-1])  # verified here, once for all cells
        except CheckpointError as e:
            raise CheckpointError(f"{e}, or remove {folder} and train it again") from e
        return False
    begin(folder, task)
    # Smaller images, then fewer, where memory would not be bounded: at most as many pixels of all together.
    pixels, factor = int(scene.cameras.size[scene.train].prod(1).sum()), 2
    while factor < _SMALLEST and pixels > factor**2 * _PIXELS:
        factor += 1
    own = replace(
        config,
        downscale=factor * (config.downscale or 1),
        # The levels that one piece would be trained on, of images which are smaller already.
        coarse=min(1.0, config.coarse / config.overview / 3 ** math.log2(factor)),
        # As many as one piece would have by then.
        cap=round(config.initial * (config.cap / config.initial) ** min(1.0, config.overview / config.grow)),
        steps=max(1, round(config.overview * config.steps)),
        minutes=None if config.minutes is None else config.overview * config.minutes,
    )
    facts = Run(root).load_known().facts
    small = read_scene(own, facts)
    small = replace(small, train=small.train[:: -(-pixels // (factor**2 * _PIXELS))])
    own = replace(own, steps=max(own.steps, _VISITS * len(small.train)))
    facts = replace(facts, held=other_views(small, small.train.tolist()) if facts.exposure or facts.centres else ())
    learn(build(own, small, facts), Run(folder), schedule_of(own), report, spent=spent)
    write_json(folder / "done.json", {"format": _FORMAT, "task": task})
    return True


def train_cell(task: CellTask, report: Callable[[Report], None]) -> bool:
    """Train a cell to its end, from its newest checkpoint; False where it was finished already.

    Raises ConfigError where the images are not those of the run, DataError where another process trains the cell,
    CheckpointError where the whole scene was not trained before.
    """
    root = Path(task.root)
    folder = folder_of(root, task.cell)
    config = Run(root).load_config()[0]
    assert isinstance(config, GaussiansConfig)
    scene = _read_views(root, config, Path(task.data))
    cell = read_cells(root)[task.cell]
    with held(folder):
        start = _load_overview(root)
        named = _task(config, scene, list(cell.windows), cell, checkpoint.digest(root / OVERVIEW / "checkpoints"))
        asked = {"format": _FORMAT, "task": named, "steps": config.steps, "minutes": config.minutes}
        if _read_done(folder) == asked:
            return False
        begin(folder, named)
        steps = max(1, round((1 - config.overview) * config.steps))
        own = replace(config, rate=_RATE * config.rate, steps=steps, minutes=task.minutes)
        facts = Run(root).load_known().facts
        learn(_learner(own, scene, facts, cell, start), Run(folder), schedule_of(own), report)
        write_json(folder / "done.json", asked)
    return True


def schedule_of(config: GaussiansConfig) -> Schedule:
    """All steps and minutes of a part: passes limit whole scenes alone."""
    return Schedule(config.steps, config.minutes, config.checkpoint_minutes)


def other_views(scene: Scene, views: Iterable[int]) -> tuple[int, ...]:
    """Numbers of the views that are not among some."""
    return tuple(sorted(set(range(len(scene.paths))) - set(views)))


def _learner(config: GaussiansConfig, scene: Scene, facts: Facts, cell: Cell, start: checkpoint.Saved) -> GaussianLearner:
    """A cell's windows, and the Gaussians of the whole scene that they show."""
    scene = replace(scene, cameras=refined(scene.cameras, start))
    images, masks = load_photographs(config, scene, list(cell.windows))
    skies = load_skies(config, scene, images)
    images, masks, skies = crop(cell, images), crop(cell, masks), crop(cell, skies)
    near, whole = float(start.model["near"]), from_tensors(start.model)
    shown = shown_in_windows(scene, cell, whole, near)
    gaussians = whole.select(shown)
    own = scene_in_windows(scene, cell)
    # Only what lies inside and in the border becomes more: its share of all that may be added.
    around = int(cell.around(gaussians.means).sum())
    cap = len(gaussians) + round(max(config.cap - len(whole), 0) * around / len(whole))
    tones = _tones_of(facts, start)
    tones = tones and tones.going_on(other_views(scene, cell.windows))
    levels = make_levels(own, images, masks, near, skies)
    narrow = limit_widths(scene, near, cells=True)  # of all cameras: what lies before those of other cells is part of the union
    learner = GaussianLearner(
        replace(config, cap=cap),
        levels,
        reach_of(own),
        cap,
        cell.around,
        narrow,
        near=near,
        tones=tones,
        part=Part(start.step, config.overview, 1.0),
        known=known_of(own, config.data, facts),
        origin="the whole scene",
    )
    # As if the number had grown from the beginning of the schedule.
    passed = min(config.overview / config.grow, 0.99)
    begun = max(1, round((len(gaussians) / cap**passed) ** (1 / (1 - passed))))
    moments = {name: start.optimizer[name][shown] for name in _MOMENTS}
    learner.load(State(vars(gaussians), {**moments, "begun": torch.tensor(begun)}))
    return learner


def _tones_of(facts: Facts, start: checkpoint.Saved) -> Tones | None:
    """The exposures that cells go on from; None where none are learnt."""
    if "tones.gain.value" not in start.optimizer:
        return None
    gain, exponent = (start.optimizer[f"tones.{name}.value"] for name in ("gain", "exponent"))
    never = (gain == 0).all(1).nonzero()[:, 0]  # views that only cells learn from
    tones = Tones(torch.tensor(facts.exposure), tuple(never.tolist()))
    tones.load_state_dict({"gain": gain, "exponent": exponent})
    return tones


def _task(config: GaussiansConfig, scene: Scene, views: list[int], cell: Cell | None = None, start: str = "") -> str:
    """Digest of what is asked for, steps and minutes aside; while it stays the same, what was trained stays good."""
    tree = to_json(config)
    assert isinstance(tree, dict)
    parts: dict[str, Any] = {
        "format": _FORMAT,
        "start": start,
        "config": {name: value for name, value in tree.items() if name not in (*RESUMABLE, *config.untrained, "cells")},
        "cameras": [scene.cameras.pose[views].tolist(), scene.cameras.focal[views].tolist()],
    }
    if cell is not None:
        bounds = (cell.frame, cell.low, cell.high, cell.border)
        parts |= {"bounds": [each.tolist() for each in bounds], "windows": sorted(cell.windows.items())}
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode())
    for view in views:
        digest.update(zlib.crc32(scene.paths[view].read_bytes()).to_bytes(4, "little"))
    return digest.hexdigest()[:32]


def _read_done(folder: Path) -> dict[str, Any] | None:
    file = folder / "done.json"
    if not file.is_file():
        return None
    with open_json(file, "remove it and train again") as document:
        return from_json(document, dict[str, Any], path="done")


def unite(root: Path, cells: Sequence[Cell]) -> int:
    """Write the union of all cells as the run's checkpoint; the number of its Gaussians.

    Raises CheckpointError where a cell is not finished.
    """
    start = _load_overview(root)
    parts: list[tuple[Tensor, ...]] = []
    step, seconds = start.step, start.seconds
    lights: list[dict[str, Tensor]] = []
    for number, cell in enumerate(cells):
        folder = folder_of(root, number)
        saved, _ = checkpoint.load_latest(folder / "checkpoints")
        if saved is None or _read_done(folder) is None:
            raise CheckpointError(f"{folder}: this cell is not finished; go on with `fprf train {root / 'config.json'}`")
        gaussians = from_tensors(saved.model)
        parts.append(tuple(vars(gaussians.select(cell.holds(gaussians.means))).values()))
        lights.append({name: each.clone() for name, each in saved.optimizer.items() if name.startswith("tones.")})
        step, seconds = max(step, start.step + saved.step), seconds + saved.seconds
    gaussians = Gaussians(*(torch.cat(column) for column in zip(*parts, strict=True)))
    tones = _mean_tones(_tones_of(Run(root).load_known().facts, start), lights, cells)
    state = tensors_of(gaussians, float(start.model["near"]))
    moves = {name: each for name, each in start.optimizer.items() if name == MOVES}
    checkpoint.write(Run(root).checkpoints, state, tones | moves, step=step, seconds=seconds)
    return len(gaussians)


def _mean_tones(start: Tones | None, found: list[dict[str, Tensor]], cells: Sequence[Cell]) -> dict[str, Tensor]:
    """Average the exposure parameters of cells: for each view, over the cells that have a window of it."""
    if start is None:
        return {}
    views = len(start.exposure)
    total, count = torch.zeros(views, 3), torch.zeros(views, 1)
    for each, cell in zip(found, cells, strict=True):
        used = list(cell.windows)
        tones = start.going_on(tuple(sorted(set(range(views)) - set(used))))
        tones.load_state_dict({name: each[f"tones.{name}.value"] for name in ("gain", "exponent")})
        total[used] += tones.gains().detach()[used]
        count[used] += 1
    gain = torch.where(count > 0, total / count.clamp_min(1), start.gains().detach())
    return {"tones.gain.value": gain, "tones.exponent.value": start.exponent.detach()}
