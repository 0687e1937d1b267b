"""One block as a task: idempotent, resumable, in a folder of its own, so that it can run anywhere and again."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from ..blocks.plan import pixel_mask
from ..config import TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.scene import Scene
from ..errors import ConfigError
from ..interfaces import DataManager
from ..io.atomic import write_json
from ..types import Boxes
from . import tensorfiles
from .blocks import SURROUNDINGS, Built, folder_of, inset, load_finished, read_done, restore, save_finished, surroundings
from .checkpoint import reached
from .lay_out import RAYS, asked_of, load_boxes
from .lock import held
from .model import Facts, Model
from .prepare import Prepared, build_encoders, cache_folder, scene_of
from .run import Run
from .trainer import Report, train

__all__ = ["BlockTask", "built_block", "train_block"]


WARM_UP = 20
"""Most steps of warm-up of a block: what it inherits is no random start, only Adam's averages are new."""


@dataclass(frozen=True, kw_only=True)
class BlockTask:
    """What a worker is told; the rest lies in the run folder. Small, so that it can be sent to other machines."""

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


def train_block(task: BlockTask, report: Callable[[Report], None], begun: Callable[[Model], None] = lambda model: None) -> bool:
    """Train a block to its end, from its newest checkpoint; False where it was finished already. `begun` is given its model.

    A folder that was trained as something else (other bounds, rays, images or knobs) is started anew. Raises ConfigError
    where the images are not those of the run, DataError where another process trains the block at this moment.
    """
    with held(folder_of(Path(task.root), task.block)):
        return _train_held(task, report, begun)


def _train_held(task: BlockTask, report: Callable[[Report], None], begun: Callable[[Model], None]) -> bool:
    root = Path(task.root)
    run = Run(root)
    config = run.load_config()[0].fields_only(root)
    facts, boxes = run.load_known().facts, load_boxes(root)
    folder = folder_of(root, task.block)
    scene = scene_of(replace(config, data=Path(task.data)))
    own = _scene_of(scene, folder)
    asked = asked_of(config, facts, scene, boxes, task.block, tensorfiles.read(folder / RAYS))
    done = read_done(folder)
    if done is not None and done["asked"] == asked:
        return False
    config = replace(config, minutes=task.minutes)  # its part alone is not what was asked: it changes from call to call
    _begin(folder, asked["task"])
    manager = _manager(run, config, facts, own, folder)
    built = built_block(root, config, facts, boxes, task.block, own.train)
    block_run = Run(folder)
    prepared, lead = Prepared(own, manager, facts, None), 0
    if task.block != SURROUNDINGS:
        lead = load_finished(folder_of(root, SURROUNDINGS), verify=False).step
        config = replace(config, optimizer=replace(config.optimizer, warm_up=min(config.optimizer.warm_up, WARM_UP)))
    begun(built.model)
    train(config, prepared, block_run, report, model=built.model, lead=lead)
    step, seconds = reached(block_run.checkpoints)
    save_finished(folder, built, asked=asked, step=step, seconds=seconds)
    return True


def _begin(folder: Path, task: str) -> None:
    """Clear what was trained as something else; what belongs to this task stays, so that it is gone on with."""
    mark = folder / "task.json"
    known = json.loads(mark.read_text()).get("task") if mark.is_file() else None
    (folder / "done.json").unlink(missing_ok=True)
    if known == task:
        return
    mark.unlink(missing_ok=True)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    for name in ("block.safetensors", "events.jsonl"):
        (folder / name).unlink(missing_ok=True)
    write_json(mark, {"task": task})


def _scene_of(scene: Scene, folder: Path) -> Scene:
    """The scene with the training views that a block learns from."""
    views = tensorfiles.read(folder / RAYS)["views"]
    if len(views) and int(views.max()) >= len(scene.paths):
        raise ConfigError(f"{folder}: its views are not those of {scene.name}; train with the scene that the run was cut from")
    return replace(scene, train=views)


def _manager(run: Run, config: TrainConfig, facts: Facts, scene: Scene, folder: Path) -> DataManager:
    """The block's own batches: its views, its pixels, the whole scene's basis; features are in the cache."""
    rays = tensorfiles.read(folder / RAYS)
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


def built_block(root: Path, config: TrainConfig, facts: Facts, boxes: Boxes, block: int, views: Tensor) -> Built:
    """The model of a block, inside of its finished surroundings."""
    around = surroundings(config, facts, boxes)
    if block == SURROUNDINGS:
        return around
    finished = load_finished(folder_of(root, SURROUNDINGS)).tensors
    own = {name: tensor.clone() for name, tensor in finished.items()}  # training writes to them, the file stays
    restore(around.member, "member", own)
    restore(around.model.decoder, "decoder", own)
    if around.model.tones is not None:
        restore(around.model.tones, "tones", own)
    if around.model.poses is not None:
        restore(around.model.poses, "poses", own)
    around.member.requires_grad_(True)
    return inset(config, facts, boxes, block, around, views)
