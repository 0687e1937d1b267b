"""Scenes of Gaussians in cells, each a task of its own (`training.tasks`); how they are cut says
`blocks.windows`.

The whole scene is trained first, on photographs of half the size, for most of the schedule. Each cell goes on
from there, with the poses that were refined there. It starts from Gaussians of the whole scene: those that
its windows show explain what lies outside, and are dropped in the end.

    RUN/overview, RUN/cells/NN      the whole scene, and the cells (see `training.tasks`)
    RUN/checkpoints                 the union of all cells
"""

import math
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..blocks.partition import read_cells, write_cells
from ..blocks.windows import held_apart
from ..datamanagers.images import load_images
from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError
from ..interfaces import State
from ..ops.rasterise.gsplat import usable
from ..ops.rasterise.rendering import lift
from ..progress import Display
from ..rendering.cameras import Cameras
from ..run_config import RESUMABLE
from ..scenes import Partition
from ..training import checkpoint
from ..training.camera_optimizers import Tones
from ..training.driver import Schedule
from ..training.facts import Facts
from ..training.prepare import device_of, read_scene
from ..training.run import Run, known_of
from ..training.tasks import WHOLE, Part, Task, digest_of, read_done, train_all
from ..types import Cell
from .config import UNTRAINED, GaussiansConfig
from .gaussians import Gaussians, from_tensors, joined, tensors_of
from .initial import curve_order
from .learner import CPU, Bounds, GaussianLearner, RunSource, Stage, left_out, refined
from .levels import in_view
from .photographs import load_photographs, make_levels
from .pinholes import covering
from .setup import build, light_and_poses, limit_widths, scene_scale
from .view_corrections import MOVES, ViewCorrections

PixelType = TypeVar("PixelType", bound=np.generic)
_CELL_VERSION = 6
"""Version of how a cell is trained: another one trains it anew."""
_MOMENTS = ("first", "second", "weight")
"""Names in checkpoints of Adam's moments, and of the weights in the second."""
_MAX_OVERVIEW_PIXELS = 16_000_000
"""Pixels of all photographs that the whole scene is trained on, at most: bounds its memory, 1.6 GiB for 16
towns (district.json).
"""
_MAX_OVERVIEW_REDUCTION = 4
"""Reduction of photographs before some are left out; by eye."""
_CELL_RATE = 0.5
"""Factor of the learning rates in cells, whose windows are seen more often than the photographs of the whole
scene; by eye.
"""
_MIN_OVERVIEW_PASSES = 10
"""Times that the whole scene sees each photograph, at least, however few `steps` there are: cells do not make
up for fewer; by eye.
"""
_MAX_PASSED_SHARE = 0.99
"""Share of the growth that is taken to be over when a cell begins, at most: at 1 it would have no beginning."""

# Which Gaussians the windows of a cell show.

_SHOWN_DEVIATIONS = 3.0
"""A Gaussian is shown as far as so many standard deviations from its mean: 98.9 % of its weight."""
_RUN_LENGTH = 256
"""Gaussians, near to each other, that are looked for together; by eye."""
_MAX_DRAWN_WINDOWS = 40
"""Windows that are drawn to see what they show, at most, evenly over all; by eye."""
_WINDOW_REDUCTION = 4
"""Reduction of the windows for that; by eye."""
_MIN_SHOWN_WEIGHT = 0.003
"""Sum of the weights of a Gaussian in all pixels of a window from which on it is shown; by eye: below a 256th
of a pixel.
"""


def folder_of(root: Path, cell: int) -> Path:
    """Folder of a cell, or of the whole scene, in a run."""
    if cell == WHOLE:
        return root / "overview"
    return root / "cells" / f"{cell:02d}"


def load_cells(root: Path) -> list[Cell]:
    """The cells of a run. Raises CheckpointError where the file cannot be read."""
    return read_cells(root / "cells.json")


class Cells(Partition):
    """A scene that is ready to be trained cell by cell."""

    def __init__(
        self,
        config: GaussiansConfig,
        scene: ParsedScene,
        cells: Sequence[Cell],
        saved: Facts | None,
        *,
        device: torch.device = CPU,
    ) -> None:
        self.config = config
        self.scene = scene
        self.cells = cells
        self.device = device
        self._facts = saved or light_and_poses(
            config, scene, lambda view: load_images(scene, config.background, [view])[0]
        )

    @property
    def facts(self) -> Facts:
        return self._facts

    def train(self, run: Run, display: Display, *, spent: float) -> None:
        """Train the whole scene and all cells, those with the largest windows first, and unite them. Finished
        ones stay.
        """
        config = self.config
        size = self.scene.cameras.size
        cells = self.cells
        self.write(run)
        pixels = []
        for cell in cells:
            pixels.append(sum(width * height for _, _, width, height in cell.windows.values()))
        share = sum(pixels) / int(size[self.scene.train].prod(1).sum())
        display.say(
            f"{len(cells)} cells, whose windows are {share:.2f} times the photographs{left_out(self.device)}"
        )
        order = sorted(range(len(cells)), key=lambda cell: -pixels[cell])
        executor = config.executor.on(self.device.type if usable(self.device) else "cpu").build()
        train_all(
            config,
            run,
            executor,
            open_cell,
            order,
            whole_share=config.overview,
            spent=spent,
            quiet=display.quiet,
        )
        display.say(f"{unite(run.root, cells)} Gaussians")

    def write(self, run: Run) -> None:
        """Write the cells. Those of another cut, which could be taken for these, are removed."""
        if write_cells(run.root / "cells.json", self.cells):
            shutil.rmtree(run.root / "cells", ignore_errors=True)


def load_overview(root: Path) -> checkpoint.Saved:
    """The whole scene, mapped: of large ones a cell reads a part. Raises CheckpointError where it was not
    trained.
    """
    folder = folder_of(root, WHOLE) / "checkpoints"
    saved, _ = checkpoint.load_latest(folder, verify=False)
    if saved is None:
        raise CheckpointError(f"{folder}: no checkpoint to start a cell from; train the run again")
    return saved


@dataclass(frozen=True, kw_only=True)
class Overview(Part):
    """The whole scene, on smaller photographs, for its part of the schedule.

    Its rates fall as those of one piece do, so that cells start from the best there is.
    """

    config: GaussiansConfig
    facts: Facts
    every: int
    """One of so many photographs is learnt from."""

    def build(self) -> GaussianLearner:
        scene = read_scene(self.config, self.facts)
        facts = self.facts
        scene = replace(scene, train=scene.train[:: self.every])
        if facts.exposure or facts.centres:
            held = other_views(scene, scene.train.tolist())
        else:
            held = ()
        return build(self.config, scene, replace(facts, held=held), device=device_of(self.config.device))

    def is_intact(self) -> bool:
        """Verify the checkpoint, once for all cells. Raises CheckpointError where it is damaged."""
        kept = checkpoint.steps(self.folder / "checkpoints")
        try:
            return bool(kept) and checkpoint.load(self.folder / "checkpoints", kept[-1]).step == kept[-1]
        except CheckpointError as e:
            raise CheckpointError(f"{e}, or remove {self.folder} and train it again") from e


@dataclass(frozen=True, kw_only=True)
class CellPart(Part):
    """A cell: its windows, and the Gaussians of the whole scene that they show."""

    config: GaussiansConfig
    scene: ParsedScene
    facts: Facts
    cell: Cell
    start: checkpoint.Saved

    def build(self) -> GaussianLearner:
        """Go on from the whole scene, at lower rates."""
        config = self.config
        cell = self.cell
        start = self.start
        # Photographs, from where the whole scene found its views, as far as the cell's windows reach. Lengths
        # follow from the cell's own cameras: points of the whole scene say nothing about it.
        cameras = refined(self.scene.cameras, self.scene.train.tolist(), self.facts, start)
        scene = replace(self.scene, cameras=cameras, points=None, seen=None)
        images, masks, skies = load_photographs(config, scene, list(cell.windows))
        images = crop(cell, images)
        masks = crop(cell, masks)
        skies = crop(cell, skies)
        # Gaussians of the whole scene that these show.
        near = float(start.model["near"])
        whole = from_tensors(start.model)
        own = scene_in_windows(scene, cell)
        shown = shown_in_windows(own.cameras, cell, whole, near)
        gaussians = whole.select(shown)
        # Only what lies inside and in the border becomes more: its share of all that may be added.
        around = int(cell.around(gaussians.means).sum())
        cap = len(gaussians) + round(max(config.most - len(whole), 0) * around / len(whole))
        tones = overview_tones(self.facts, start)
        if tones is not None:
            tones = tones.going_on(other_views(scene, cell.windows))
        device = device_of(config.device)
        learner = GaussianLearner(
            replace(config, cap=cap, rate=_CELL_RATE * config.rate),
            make_levels(own, images, masks, near, skies, device=device),
            Bounds(
                room=cap,
                scene_scale=scene_scale(own),
                near=near,
                inside=cell.around,
                # Of all cameras: what lies before those of other cells is part of the union.
                limit_widths=limit_widths(scene, near, cells=True),
            ),
            corrections=ViewCorrections(tones),
            stage=Stage(before=start.step, first=config.overview),
            source=RunSource(known=known_of(own, config.data, self.facts), points="the whole scene"),
            device=device,
        )
        # Their moments go on, and their number grows as if it had from the beginning of the schedule.
        passed = min(config.overview / config.grow, _MAX_PASSED_SHARE)
        begun = max(1, round((len(gaussians) / cap**passed) ** (1 / (1 - passed))))
        moments = {}
        for name in _MOMENTS:
            moments[name] = start.optimizer[name][shown]
        learner.load(State(gaussians.tensors, {**moments, "begun": torch.tensor(begun)}))
        return learner


def open_cell(task: Task) -> Overview | CellPart:
    """The whole scene, or the cell, of a task.

    Raises ConfigError where the images are not those of the run, CheckpointError where a cell's whole scene
    was not trained.
    """
    root = Path(task.root)
    number = task.part
    folder = folder_of(root, number)
    facts = Run(root).load_known().facts
    config = Run(root).load_config()[0]
    assert isinstance(config, GaussiansConfig)  # by its kind
    scene = read_scene(replace(config, data=Path(task.data)), facts)
    # Fields of the config that may change without training a part anew.
    free = (*RESUMABLE, *UNTRAINED, "cells")
    if number == WHOLE:
        own, every = overview_config(replace(config, data=Path(task.data)), scene)
        return Overview(
            name="whole scene",
            folder=folder,
            # What is finished stays when a run is gone on with for more steps or minutes.
            asked={
                "task": digest_of(
                    config, free, scene, scene.train.tolist(), {"format": _CELL_VERSION, "start": ""}
                )
            },
            schedule=Schedule(own.most_steps, task.minutes, config.checkpoint_minutes),
            config=own,
            facts=facts,
            every=every,
        )
    cell = load_cells(root)[number]
    parts = {
        "format": _CELL_VERSION,
        "start": checkpoint.digest(folder_of(root, WHOLE) / "checkpoints"),
        "bounds": [each.tolist() for each in (cell.frame, cell.low, cell.high, cell.border)],
        "windows": sorted(cell.windows.items()),
    }
    task_digest = digest_of(config, free, scene, list(cell.windows), parts)
    steps = max(1, round((1 - config.overview) * config.most_steps))
    return CellPart(
        name=f"cell {number:02d}",
        folder=folder,
        asked={"task": task_digest, "steps": config.most_steps, "minutes": config.minutes},
        schedule=Schedule(steps, task.minutes, config.checkpoint_minutes),
        config=config,
        scene=scene,
        facts=facts,
        cell=cell,
        start=load_overview(root),
    )


def overview_config(config: GaussiansConfig, scene: ParsedScene) -> tuple[GaussiansConfig, int]:
    """Training of the whole scene before its cells, and which one of so many photographs it learns from.

    Of smaller images, then of fewer, where memory would not be bounded.
    """
    # Memory is in proportion to the pixels: half the size, then a third, a quarter, and then every other
    # photograph ...
    pixels = int(scene.cameras.size[scene.train].prod(1).sum())
    factor = 2
    while factor < _MAX_OVERVIEW_REDUCTION and pixels > factor**2 * _MAX_OVERVIEW_PIXELS:
        factor += 1
    every = -(-pixels // (factor**2 * _MAX_OVERVIEW_PIXELS))
    own = replace(
        config,
        downscale=factor * (config.downscale or 1),
        # The levels that one piece would be trained on, of images which are smaller already.
        coarse=min(1.0, config.coarse / config.overview / 3 ** math.log2(factor)),
        # As many as one piece would have by then.
        cap=round(config.initial * (config.most / config.initial) ** min(1.0, config.overview / config.grow)),
        steps=max(
            1, round(config.overview * config.most_steps), _MIN_OVERVIEW_PASSES * len(scene.train[::every])
        ),
    )
    return own, every


def other_views(scene: ParsedScene, views: Iterable[int]) -> tuple[int, ...]:
    """Numbers of the views that are not among some."""
    return tuple(sorted(set(range(len(scene.paths))) - set(views)))


def scene_in_windows(scene: ParsedScene, cell: Cell) -> ParsedScene:
    """The scene that a cell sees: its windows are the training views."""
    views = torch.tensor(list(cell.windows), dtype=torch.int64)
    window = torch.tensor(list(cell.windows.values()), dtype=torch.int64)
    centre = scene.cameras.centre.clone()
    size = scene.cameras.size.clone()
    centre[views] -= window[:, :2]
    size[views] = window[:, 2:]
    return replace(scene, cameras=replace(scene.cameras, centre=centre, size=size), train=views)


def crop(cell: Cell, images: dict[int, NDArray[PixelType]]) -> dict[int, NDArray[PixelType]]:
    """A cell's windows of images [H W ...] by view."""
    cropped = {}
    for view, image in images.items():
        left, top, width, height = cell.windows[view]
        cropped[view] = image[top : top + height, left : left + width]
    return cropped


def shown_in_windows(
    cameras: Cameras, cell: Cell, gaussians: Gaussians, near: float
) -> Annotated[Tensor, "N"]:
    """True for Gaussians that a window shows, and for all in the cell and its border.

    `cameras` are those of `scene_in_windows`. What others hide, and what covers next to nothing, is not
    shown, so their number does not grow with the scene.
    """
    visible = cell.around(gaussians.means)
    # Runs [B R] of Gaussians near to each other, the last one repeated, with balls around what they show:
    # most windows show few of them.
    order = torch.from_numpy(curve_order(gaussians.means.double().numpy()))
    order = torch.nn.functional.pad(order[None], (0, -len(order) % _RUN_LENGTH), mode="replicate").view(
        -1, _RUN_LENGTH
    )
    means = gaussians.means[order]
    quaternions = gaussians.quaternions[order]
    log_scales = gaussians.log_scales[order]
    centre = (means.double().amin(1) + means.double().amax(1)) / 2
    reach = _SHOWN_DEVIATIONS * log_scales.amax(2).double().exp()
    radius = ((means.double() - centre[:, None]).norm(dim=2) + reach).amax(1)
    logits = gaussians.logits[order]
    logits.view(-1)[len(gaussians) :] = -math.inf  # the repeated ones
    # Draw the runs in view of each window, coarsely, and keep what weighs anything there.
    shown = torch.zeros(order.shape, dtype=torch.bool)
    views = list(cell.windows)
    for view in views[:: -(-len(views) // _MAX_DRAWN_WINDOWS)]:
        camera = covering(cameras.select(torch.tensor([view])).scaled(_WINDOW_REDUCTION), 0, near)
        runs = torch.from_numpy(in_view(camera, centre.numpy(), radius.numpy())[1]).nonzero()[:, 0]
        mean = means[runs].flatten(0, 1)
        quaternion = quaternions[runs].flatten(0, 1)
        log_scale = log_scales[runs].flatten(0, 1)
        ones = torch.ones(camera.height, camera.width, 1)
        weights = lift(mean, quaternion, log_scale, logits[runs].flatten(), camera, ones, antialiased=True)
        shown[runs] |= weights.view(-1, _RUN_LENGTH) > _MIN_SHOWN_WEIGHT
    visible[order[shown]] = True
    return visible


def overview_tones(facts: Facts, start: checkpoint.Saved) -> Tones | None:
    """The exposures that cells go on from; None where none are learnt."""
    if "tones.gain.value" not in start.optimizer:
        return None
    gain = start.optimizer["tones.gain.value"]
    exponent = start.optimizer["tones.exponent.value"]
    never = (gain == 0).all(1).nonzero()[:, 0]  # views that only cells learn from
    tones = Tones(torch.tensor(facts.exposure), tuple(never.tolist()))
    tones.load_state_dict({"gain": gain, "exponent": exponent})
    return tones


def unite(root: Path, cells: Sequence[Cell]) -> int:
    """Write the union of all cells as the run's checkpoint; the number of its Gaussians.

    Each view has the mean exposure of the cells that have a window of it. Raises CheckpointError where one is
    not finished.
    """
    start = load_overview(root)
    # Exposures are averaged over cells as factors: of each view, those of the cells that have a window of it.
    tones = overview_tones(Run(root).load_known().facts, start)
    parts: list[Gaussians] = []
    step = start.step
    seconds = start.seconds
    gain = torch.zeros(0)
    count = torch.zeros(0)
    if tones is not None:
        gain = torch.zeros_like(tones.gains())
        count = torch.zeros(len(tones.exposure), 1)
    for number, cell in enumerate(cells):
        folder = folder_of(root, number)
        saved, _ = checkpoint.load_latest(folder / "checkpoints")
        if saved is None or read_done(folder) is None:
            raise CheckpointError(
                f"{folder}: this cell is not finished; go on with `fprf train {root / 'config.json'}`"
            )
        # What lies outside of the cell only explained what its windows show: its own cells know it better.
        gaussians = from_tensors(saved.model)
        parts.append(gaussians.select(held_apart(cells, number, gaussians.means)))
        step = max(step, start.step + saved.step)
        seconds = seconds + saved.seconds
        if tones is not None:
            used = list(cell.windows)
            own = tones.going_on(tuple(sorted(set(range(len(gain))) - set(used))))
            learnt = {}
            for name in ("gain", "exponent"):
                learnt[name] = saved.optimizer[f"tones.{name}.value"].clone()
            own.load_state_dict(learnt)
            gain[used] += own.gains().detach()[used]
            count[used] += 1
    # What no cell holds is as the whole scene has it.
    around = from_tensors(start.model)
    held = torch.zeros(len(around), dtype=torch.bool)
    for cell in cells:
        held |= cell.holds(around.means)
    if not bool(held.all()):
        parts.append(around.select(~held))
    # Poses were refined in the whole scene alone.
    gaussians = joined(parts)
    corrections = {}
    for name, each in start.optimizer.items():
        if name == MOVES:
            corrections[name] = each
    if tones is not None:
        gain = torch.where(count > 0, gain / count.clamp_min(1), tones.gains().detach())
        corrections |= {"tones.gain.value": gain, "tones.exponent.value": tones.exponent.detach()}
    state = tensors_of(gaussians, float(start.model["near"]))
    checkpoint.write(Run(root).checkpoints, state, corrections, step=step, seconds=seconds)
    return len(gaussians)
