"""Scenes of blocks: cut them, extract all features, write down what every block will need, and train each as a task.

Images are decoded one at a time and features are mapped from their files, so memory does not grow with the scene. One
semantic basis, one unit of each loss and one cache serve all blocks.
"""

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from ..blocks.partition import write_cells
from ..blocks.visibility import Plan, make_plan, pixel_mask
from ..config import TrainConfig, fields_only
from ..datamanagers.basis import Basis
from ..datamanagers.features import extract
from ..datamanagers.images import load_image
from ..datamanagers.scene import Scene
from ..errors import ConfigError
from ..interfaces import DataManager, Partition
from ..progress import Display
from ..style.scene import to_tensors
from . import tensorfiles
from .blocks import (
    RAYS,
    SURROUNDINGS,
    asked_of,
    built_block,
    folder_of,
    load_blocks,
    load_finished,
    read_done,
    save_finished,
)
from .driver import Report, Schedule, learn, reporter
from .learner import FieldLearner, outcome
from .loading import load_run
from .model import Facts, build_decoder
from .prepare import Prepared, behind, build_encoders, cache_folder, device_of, exposure_of, field_facts, read_scene
from .run import Run, begin, held, task_of
from .style_pass import measure_style


def cut(
    config: TrainConfig,
    scene: Scene,
    saved: Facts | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> "Blocks | None":
    """Blocks of a scene with the features of all training views; None where the layout leaves it in one piece.

    Arguments as of `RunConfig.build`.
    """
    plan = make_plan(scene, config.blocks)
    if len(plan.cells) == 1:
        return None
    content, semantic = build_encoders(config)
    build_decoder(config, encoder=content.identity, channels=content.channels)  # refused now, not after all the features
    background, cache, views = behind(config, scene), cache_folder() / "features", scene.train.tolist()

    def image(view: int) -> Tensor:
        width, height = scene.cameras.size[view].tolist()
        return torch.from_numpy(load_image(scene.paths[view], (width, height), background))

    guided = config.datamanager.guided
    content_store = extract(cache / "content", views, image, content, guided, progress=progress)
    semantic_store = None
    if semantic is not None:
        dim = config.semantic.dim
        semantic_store = extract(cache / "semantic", views, image, semantic, guided, dim=dim, progress=progress)
    exposure = exposure_of(config.tones, scene, lambda view: image(view).float() / 255, saved)
    facts = field_facts(config, scene, plan.space, exposure, (content, semantic), (content_store, semantic_store))
    return Blocks(config, scene, plan, facts, None if semantic_store is None else semantic_store.basis)


class Blocks(Partition):
    """A scene that is ready to be trained block by block."""

    def __init__(self, config: TrainConfig, scene: Scene, plan: Plan, facts: Facts, basis: Basis | None) -> None:
        self.config, self.scene, self.plan, self.basis = config, scene, plan, basis
        self._facts = facts

    @property
    def facts(self) -> Facts:
        return self._facts

    def train(self, run: Run, display: Display, *, spent: float) -> None:
        """The surroundings, the blocks, largest first, and the style of the whole. Finished ones stay."""
        config, scene = self.config, self.scene
        self.write_down(run)
        count = len(self.plan.cells)
        display.say(f"{count} blocks and their surroundings")
        executor = config.executor.on(device_of(config.device).type).build()
        around, each = block_minutes(config, count, spent)
        folder = config.data or Path()
        root, data = str(run.root.resolve()), str(folder.resolve() if folder.exists() else folder)

        def task(block: int, minutes: float | None) -> BlockTask:
            return BlockTask(root=root, data=data, block=block, minutes=minutes, quiet=display.quiet)

        executor.map(run_block, [task(SURROUNDINGS, around)])
        executor.map(run_block, [task(block, each) for block in self.plan.rays.argsort(descending=True).tolist()])
        display.say("measuring the scene's own style")
        trained = load_run(run.root, config.device)
        run.save_tensors("style", to_tensors(measure_style(config, trained.model, scene.cameras, scene.train)))
        display.say(outcome(run, config, scene))

    def write_down(self, run: Run) -> None:
        """Everything that the tasks read, and the cut, into the run folder."""
        plan = self.plan
        if self.basis is not None:
            run.save_tensors("basis", self.basis.tensors())
        count = len(plan.cells)
        rays = {block: _rays_of(plan, block) for block in (SURROUNDINGS, *range(count))}
        if trained_tasks(run.root):
            asked = {
                block: asked_of(self.config, self.facts, self.scene, plan.cells, block, own)["task"]
                for block, own in rays.items()
            }
            renumber(run.root, {block: task for block, task in asked.items() if block != SURROUNDINGS})
        for block, own in rays.items():
            folder = folder_of(run.root, block)
            folder.mkdir(parents=True, exist_ok=True)
            tensorfiles.save(folder / RAYS, own)
        write_cells(run.root / "blocks.json", plan.cells)


SHARE = 0.2
"""Share of a time limit that the surroundings take, which all blocks start from; the blocks share the rest."""


def block_minutes(config: TrainConfig, blocks: int, spent: float) -> tuple[float | None, float | None]:
    """Minutes for the surroundings, and for each block, one after the other; `spent` seconds of the limit are gone."""
    if config.minutes is None:
        return None, None
    left = max(config.minutes - spent / 60, 0.05 * config.minutes)
    return SHARE * left, (1 - SHARE) * left / blocks


def run_block(task: "BlockTask") -> None:
    """Train one block, here or on a worker, and show how it goes."""
    name = "surroundings" if task.block == SURROUNDINGS else f"block {task.block:02d}"
    with Display(quiet=task.quiet) as display:
        if not train_block(task, reporter(display, Run(folder_of(Path(task.root), task.block)), name)):
            display.say(f"{name} is finished already")


def _rays_of(plan: Plan, block: int) -> dict[str, Tensor]:
    """Training data of a block: `views` [M] and their tiles `seen` [M TILES TILES]; the surroundings from everything."""
    views = plan.views if block == SURROUNDINGS else plan.views_of(block)
    at = torch.isin(plan.views, views)
    seen = torch.ones_like(plan.seen[:, 0]) if block == SURROUNDINGS else plan.seen[:, block]
    return {"views": views, "seen": seen[at].to(torch.uint8)}


_MOVING = "moving-"


def trained_tasks(root: Path) -> dict[Path, str]:
    """Folders of blocks in a run, whatever their numbers, and what each was begun as."""
    tasks = {}
    for mark in sorted((root / "blocks").glob("*/task.json")):
        match task_of(mark.parent):
            case {"task": str(task)}:
                tasks[mark.parent] = task
    return tasks


def renumber(root: Path, asked: Mapping[int, str]) -> None:
    """Move each folder that was begun as what some block is asked for now to that block's number.

    A folder in the way that nobody asks for is removed. Where it is cut off, the next call finishes it.
    """
    known = trained_tasks(root)
    moves: dict[int, Path] = {}
    for block, task in asked.items():
        if known.get(folder_of(root, block)) == task:
            known.pop(folder_of(root, block))
    for block, task in asked.items():
        holder = next((folder for folder, was in known.items() if was == task), None)
        if holder is not None:
            known.pop(holder)
            moves[block] = holder
    # Twice, so that no folder stands in another's way.
    for block, holder in moves.items():
        os.rename(holder, _aside(root, asked[block]))
    for block in moves:
        target = folder_of(root, block)
        shutil.rmtree(target, ignore_errors=True)
        os.rename(_aside(root, asked[block]), target)
    for left in (root / "blocks").glob(f"{_MOVING}*"):
        shutil.rmtree(left)


def _aside(root: Path, task: str) -> Path:
    return root / "blocks" / f"{_MOVING}{task}"


WARM_UP = 20
"""Most steps of warm-up of a block: what it inherits is no random start, only Adam's averages are new."""


@dataclass(frozen=True, kw_only=True)
class BlockTask:
    """Message to a worker; the rest lies in the run folder. Small, so that it can be sent to other machines."""

    root: str
    """Run folder."""
    data: str
    """Scene folder."""
    block: int
    """Number of the block, or SURROUNDINGS."""
    minutes: float | None
    """Its part of the time limit."""
    quiet: bool = False
    """Show nothing."""


def train_block(task: BlockTask, report: Callable[[Report], None]) -> bool:
    """Train a block to its end, from its newest checkpoint; False where it was finished already.

    A folder that was trained as something else (other bounds, rays, images or knobs) is started anew. Raises ConfigError
    where the images are not those of the run, DataError where another process trains the block at this moment.
    """
    with held(folder_of(Path(task.root), task.block)):
        return _train_held(task, report)


def _train_held(task: BlockTask, report: Callable[[Report], None]) -> bool:
    root = Path(task.root)
    run, folder = Run(root), folder_of(root, task.block)
    config = fields_only(run.load_config()[0], root)
    facts, cells, rays = run.load_known().facts, load_blocks(root), tensorfiles.read(folder / RAYS)
    scene, views = read_scene(replace(config, data=Path(task.data)), facts), rays["views"]
    if len(views) and int(views.max()) >= len(scene.paths):
        raise ConfigError(f"{folder}: its views are not those of {scene.name}; train with the scene that the run was cut from")
    asked = asked_of(config, facts, scene, cells, task.block, rays)
    done = read_done(folder)
    if done is not None and done.asked == asked:
        return False
    config = replace(config, minutes=task.minutes)  # its part alone is not what was asked: it changes from call to call
    begin(folder, {"task": asked["task"]})
    own = replace(scene, train=views)
    built = built_block(root, config, facts, cells, task.block, views)
    block_run = Run(folder)
    prepared, lead = Prepared(own, _manager(run, config, facts, own, rays), facts, None), 0
    if task.block != SURROUNDINGS:
        lead = load_finished(folder_of(root, SURROUNDINGS), verify=False).step
        config = replace(config, optimizer=replace(config.optimizer, warm_up=min(config.optimizer.warm_up, WARM_UP)))
    learner = FieldLearner(config, prepared, device_of(config.device), built.model, lead=lead)
    reached = learn(learner, block_run, Schedule(config.steps, config.minutes, config.checkpoint_minutes), report)
    save_finished(folder, built, asked=asked, step=reached.step, seconds=reached.seconds)
    return True


def _manager(run: Run, config: TrainConfig, facts: Facts, scene: Scene, rays: dict[str, Tensor]) -> DataManager:
    """The block's own batches: its views, its pixels, the whole scene's basis; features are in the cache."""
    slots = {view: slot for slot, view in enumerate(rays["views"].tolist())}

    def seen(view: int) -> Tensor:
        width, height = scene.cameras.size[view].tolist()
        return pixel_mask(rays["seen"][slots[view]].bool(), (width, height))

    content, semantic = build_encoders(config)
    return config.datamanager.build(
        scene=scene,
        content=content,
        semantic=semantic if facts.dim else None,
        dim=config.semantic.dim,
        cache=cache_folder() / "features",
        seed=config.seed,
        basis=Basis.from_tensors(run.load_tensors("basis")) if facts.dim else None,
        seen=seen,
        background=facts.background,
    )
