"""Training a scene of fields in blocks: cut it, extract all features, and train each block as a task.

Images are decoded one at a time and features are mapped from their files, so memory does not grow with the scene. One
semantic basis, one unit of each loss and one cache serve all blocks. `RUN/blocks/NN/rays.safetensors` holds the views and tiles
that a block learns from.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..blocks.fields import BlockedField
from ..blocks.partition import Plan, make_plan, pixel_mask, write_cells
from ..blocks.routing import chart_of, surroundings_of
from ..config import FREE_IN_BLOCKS, TrainConfig, fields_only
from ..datamanagers.basis import Basis
from ..datamanagers.features import extract
from ..datamanagers.images import load_image
from ..datamanagers.scene import Scene
from ..errors import ConfigError
from ..interfaces import Learner, Partition
from ..io import tensorfiles
from ..progress import Display
from ..types import Cell
from .blocks import FILE, Built, block_in_surroundings, folder_of, load_blocks, load_finished, surroundings
from .driver import Schedule
from .learner import FieldLearner, finish
from .loading import load_run
from .model import Facts, build_decoder
from .prepare import Prepared, build_encoders, cache_folder, device_of, exposure_of, field_facts, read_scene, scene_background
from .run import Run
from .tasks import WHOLE, Part, Task, digest_of, renumber, task_of, train_all

RAYS = "rays.safetensors"
"""In a block's folder: `views` [M] and their tiles `seen` [M TILES TILES] that it learns from."""
SHARE = 0.2
"""Share of a time limit that the surroundings take; the blocks share the rest."""
WARM_UP = 20
"""Most steps of warm-up of a block: what it inherits is no random start, only Adam's averages are new."""


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
    # Features of all training views, into the cache that all blocks read.
    content, semantic = build_encoders(config)
    build_decoder(config, encoder=content.identity, channels=content.channels)  # refused now, not after all the features
    # One store for all blocks: one basis and one unit of the losses, so that features mean the same in each.
    background, cache, views = scene_background(config, scene), cache_folder() / "features", scene.train.tolist()

    def image(view: int) -> Tensor:
        width, height = scene.cameras.size[view].tolist()
        return torch.from_numpy(load_image(scene.paths[view], (width, height), background))

    guided = config.datamanager.guided
    content_store = extract(cache / "content", views, image, content, guided, progress=progress)
    semantic_store = None
    if semantic is not None:
        dim = config.semantic.dim
        semantic_store = extract(cache / "semantic", views, image, semantic, guided, dim=dim, progress=progress)
    # Exposures are relative to all views, not to those that a block sees.
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
        self.write(run)
        display.say(f"{len(self.plan.cells)} blocks and their surroundings")
        executor = config.executor.on(device_of(config.device).type).build()
        order = self.plan.rays.argsort(descending=True).tolist()
        train_all(config, run, executor, open_block, order, whole_share=SHARE, spent=spent, quiet=display.quiet)
        finish(run, display, config, load_run(run.root, config.device).model, scene)

    def write(self, run: Run) -> None:
        """Write all that tasks read. Blocks that were trained as what another number is now are moved there."""
        plan = self.plan
        if self.basis is not None:
            run.save_tensors("basis", self.basis.tensors())
        # The views that see a block, and the tiles of them whose rays meet it; the surroundings learn from everything.
        rays = {}
        for block in (WHOLE, *range(len(plan.cells))):
            views = plan.views if block == WHOLE else plan.views_of(block)
            at = torch.isin(plan.views, views)
            seen = torch.ones_like(plan.seen[at, 0]) if block == WHOLE else plan.seen[at, block]
            rays[block] = {"views": views, "seen": seen.to(torch.uint8)}
        folder = folder_of(run.root, 0).parent
        if any(task_of(part) for part in folder.glob("*")):  # digests read all images
            blocks = range(len(plan.cells))
            asked = {z: block_task(self.config, self.facts, self.scene, plan.cells, z, rays[z])["task"] for z in blocks}
            renumber(folder, asked)
        for block, own in rays.items():
            folder_of(run.root, block).mkdir(parents=True, exist_ok=True)
            tensorfiles.save(folder_of(run.root, block) / RAYS, own)
        write_cells(run.root / "blocks.json", plan.cells)


def block_task(
    config: TrainConfig, facts: Facts, scene: Scene, cells: Sequence[Cell], block: int, rays: dict[str, Tensor]
) -> dict[str, Any]:
    """The task of a block, and how long it is trained (`Part.asked`). `rays` is its rays.safetensors.

    A block is decided by its bounds and rays, its images, and the config but for what may change, not by its surroundings:
    they are only its frame.
    """
    # What the surroundings span follows from all blocks together, not from how they are cut.
    chart = surroundings_of(cells) if block == WHOLE else chart_of(cells[block])
    views, space = rays["views"].tolist(), facts.space
    parts = {
        "bounds": [chart.low.tolist(), chart.high.tolist(), torch.eye(3).tolist()],
        "space": [space.centre, space.rotation, space.scale, space.near, space.far],
        "views": views,
        "facts": [facts.channels, facts.dim, facts.content_encoder, facts.semantic_encoder, facts.background, facts.exposure],
    }
    # Tiles count as bytes: another layout around a block leaves its rays, and so its task, as they are.
    task = digest_of(config, FREE_IN_BLOCKS, scene, views, parts, rays["seen"].numpy().tobytes())
    return {"task": task, "steps": config.steps, "minutes": config.minutes}


@dataclass(frozen=True, kw_only=True)
class Block(Part):
    """A block, or the surroundings, of a run."""

    run: Run
    block: int
    config: TrainConfig
    scene: Scene
    facts: Facts
    rays: dict[str, Tensor]

    def build(self) -> FieldLearner:
        """A block inside of its finished surroundings, on its own views and pixels; features are in the cache."""
        config, facts, scene, lead = self.config, self.facts, replace(self.scene, train=self.rays["views"]), 0
        built = surroundings(config, facts, load_blocks(self.run.root))
        if self.block != WHOLE:
            done, tensors = load_finished(folder_of(self.run.root, WHOLE))
            built.restore({name: tensor.clone() for name, tensor in tensors.items()})  # training writes to them
            built.member.requires_grad_(True)
            built = block_in_surroundings(config, facts, load_blocks(self.run.root)[self.block], built, self.rays["views"])
            # Its sampler goes on where that of the surroundings stopped.
            lead = done.step
            config = replace(config, optimizer=replace(config.optimizer, warm_up=min(config.optimizer.warm_up, WARM_UP)))
        # Its pixels are those of the tiles that meet it; the basis of the semantics is the whole scene's.
        slots = {view: slot for slot, view in enumerate(self.rays["views"].tolist())}

        def seen(view: int) -> Tensor:
            width, height = scene.cameras.size[view].tolist()
            return pixel_mask(self.rays["seen"][slots[view]].bool(), (width, height))

        content, semantic = build_encoders(config)
        manager = config.datamanager.build(
            scene=scene,
            content=content,
            semantic=semantic if facts.dim else None,
            dim=config.semantic.dim,
            cache=cache_folder() / "features",
            seed=config.seed,
            basis=Basis.from_tensors(self.run.load_tensors("basis")) if facts.dim else None,
            seen=seen,
            background=facts.background,
        )
        return FieldLearner(config, Prepared(scene, manager, facts, None), device_of(config.device), built.model, lead=lead)

    def keep(self, learner: Learner) -> dict[str, Any]:
        """Write the block's fields, and what was learnt with them."""
        assert isinstance(learner, FieldLearner) and isinstance(learner.model.field, BlockedField)  # it is that of `build`
        built = Built(learner.model, learner.model.field.members.held[0])
        tensors = {f"{kind}.{name}": t for kind, part in built.kept().items() for name, t in part.state_dict().items()}
        return tensorfiles.save(self.folder / FILE, tensors)


def open_block(task: Task) -> Block:
    """The block of a task. Raises ConfigError where the images are not those of the run."""
    root, block = Path(task.root), task.part
    run, folder = Run(root), folder_of(root, block)
    config, facts = fields_only(run.load_config()[0], root), run.load_known().facts
    # A worker may see the scene at another path; views are numbers, so it must be the same scene.
    scene, rays = read_scene(replace(config, data=Path(task.data)), facts), tensorfiles.read(folder / RAYS)
    if len(rays["views"]) and int(rays["views"].max()) >= len(scene.paths):
        raise ConfigError(f"{folder}: its views are not those of {scene.name}; train with the scene that the run was cut from")
    return Block(
        name="surroundings" if block == WHOLE else f"block {block:02d}",
        folder=folder,
        asked=block_task(config, facts, scene, load_blocks(root), block, rays),
        schedule=Schedule(config.steps, task.minutes, config.checkpoint_minutes),
        run=run,
        block=block,
        config=config,
        scene=scene,
        facts=facts,
        rays=rays,
    )
