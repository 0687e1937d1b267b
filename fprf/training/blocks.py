"""A scene of fields in blocks: cut, trained block by block, and put together again for rendering.

The surroundings are trained first, on everything: a coarse scene. A block is trained inside of a copy of
them, which goes on learning with it and is then dropped: so each ray is whole while a block learns its part,
and what the block cannot explain does not end up as a veil in it. The block itself starts as what they have
learnt of its place (`blocks.fields.inherit`): a street of four blocks came out 1.9 dB better after 200 steps
each than from seeded planes.

One semantic basis, one unit of each loss and one cache of features, which are mapped from their files, serve
all blocks. While features are made, the pixels of all training views lie in a mapped file as well, three
bytes each.

    RUN/blocks.json                      the partition
    RUN/blocks/NN/rays.safetensors       the views and tiles that a block learns from
    RUN/blocks/NN/block.safetensors      a finished block, and what was learnt with it; `surroundings` is what no block holds
"""

import copy
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor, nn

from ..blocks.fields import (
    BlockedField,
    BlockedSampler,
    BlockedSemantic,
    Member,
    Members,
    ResidentMembers,
    inherit,
)
from ..blocks.partition import Plan, pixel_mask, read_cells, write_cells
from ..blocks.routing import BlendRouter, InsetRouter, Router, chart_of, surroundings_of, to_single
from ..config import FREE_IN_BLOCKS, TrainConfig, fields_only
from ..datamanagers.basis import Basis
from ..datamanagers.scene import ParsedScene
from ..errors import CheckpointError, ConfigError
from ..interfaces import Decoder, Learner, Parts
from ..io import tensorfiles
from ..progress import Display
from ..scenes import Partition
from ..testing.outputs import check_parts
from ..types import Cell
from .camera_optimizers import Poses, Tones, poses_of, tones_of
from .checkpoint import misfit
from .driver import Schedule
from .facts import Facts
from .field_learner import FieldLearner, finish
from .field_setup import prepare
from .model import Model, build_decoder, build_fields
from .prepare import device_of, read_scene
from .run import Run
from .tasks import WHOLE, Done, Part, Task, digest_of, read_done, renumber, task_of, train_all

FILE = "block.safetensors"
"""In a block's folder: its fields, and what was learnt with them."""
RAYS = "rays.safetensors"
"""In a block's folder: `views` [M] and their tiles `seen` [M TILES TILES] that it learns from."""
SHARE = 0.2
"""Share of a time limit that the surroundings take; the blocks share the rest. By eye."""
WARM_UP = 20
"""Most steps of warm-up of a block: what it inherits is no random start, only Adam's averages are new."""
_MIB = 1 << 20
"""Bytes of a MiB."""


class Built(NamedTuple):
    """A model to train, and the member of it that is kept."""

    model: Model
    member: Member

    def kept(self) -> dict[str, nn.Module]:
        """Parts that stay when a block is finished, by their names in its file."""
        parts = {
            "member": self.member,
            "decoder": self.model.decoder,
            "tones": self.model.tones,
            "poses": self.model.poses,
        }
        found: dict[str, nn.Module] = {}
        for kind, part in parts.items():
            if part is not None:
                found[kind] = part
        return found

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take what is kept from the tensors of a finished block, which are not copied."""
        for kind, part in self.kept().items():
            restore(part, kind, tensors)


def folder_of(root: Path, block: int) -> Path:
    """Folder of a block in a run."""
    return root / "blocks" / ("surroundings" if block == WHOLE else f"{block:02d}")


def load_blocks(root: Path) -> list[Cell]:
    """The blocks of a run. Raises CheckpointError where the file cannot be read."""
    return read_cells(root / "blocks.json")


def assemble(
    config: TrainConfig,
    facts: Facts,
    members: Members,
    router: Router,
    decoder: Decoder,
    tones: Tones | None,
    poses: Poses | None,
) -> Model:
    """A model whose points are routed to members."""
    sampler = BlockedSampler(config.sampler.build(seed=config.seed), members, router)
    semantic = None
    if facts.of_field.dim:
        semantic = BlockedSemantic(members, router)
    return Model(Parts(facts.space, sampler, BlockedField(members, router), semantic, decoder), tones, poses)


def surroundings(config: TrainConfig, facts: Facts, cells: Sequence[Cell]) -> Built:
    """The coarse scene that everything starts from. Raises PluginError where a part breaks its contract at
    once.
    """
    decoder = build_decoder(config, encoder=facts.of_field.content_encoder, channels=facts.of_field.channels)
    member = Member(surroundings_of(cells), *build_fields(config, facts))
    tones = tones_of(facts)
    poses = poses_of(facts, config.poses)
    model = assemble(config, facts, ResidentMembers([member]), to_single, decoder, tones, poses)
    check_parts(config, model.parts, facts.of_field.channels, facts.of_field.dim)
    return Built(model, member)


def block_in_surroundings(
    config: TrainConfig, facts: Facts, cell: Cell, around: Built, views: Annotated[Tensor, "M"]
) -> Built:
    """A block inside of a copy of its surroundings; decoder and tones are theirs, as they learnt them.

    Poses start as theirs too, and are refined further from the `views` that the block learns from.
    """
    chart = chart_of(cell)
    member = Member(chart, *build_fields(config, facts))
    # What the surroundings have learnt of this place is not learnt again.
    inherit(member, around.member)
    # Decoder and tones stay as they are, so that all blocks mean the same by a colour; the surroundings go on
    # learning.
    decoder = copy.deepcopy(around.model.decoder).requires_grad_(False)
    tones = copy.deepcopy(around.model.tones)
    poses = around.model.poses
    if tones is not None:
        tones.requires_grad_(False)
    if poses is not None:
        others = set(range(len(facts.centres))) - set(views.tolist())
        poses = poses.going_on(torch.tensor(facts.centres, dtype=torch.float64), tuple(sorted(others)))
    members = ResidentMembers([member, copy.deepcopy(around.member)])
    return Built(assemble(config, facts, members, InsetRouter(chart), decoder, tones, poses), member)


def load_finished(folder: Path, *, verify: bool = True) -> tuple[Done, dict[str, Tensor]]:
    """A finished block; its tensors are memory-mapped, and verifying reads them all. Raises
    CheckpointError.
    """
    done = read_done(folder)
    if done is None:
        again = f"fprf train {folder.parent.parent / 'config.json'}"
        raise CheckpointError(f"{folder}: this block is not finished; go on with `{again}`")
    file = folder / FILE
    return done, tensorfiles.load(file, done.tensors) if verify else tensorfiles.read(file)


def restore(module: nn.Module, kind: str, tensors: dict[str, Tensor]) -> None:
    """Give a `member`, `decoder`, `tones` or `poses` its tensors of a finished block: mapped from the file,
    not copied.
    """
    own = {}
    for name, t in tensors.items():
        if name.startswith(f"{kind}."):
            own[name.removeprefix(f"{kind}.")] = t
    wrong = misfit(module, own)
    if wrong is not None:
        raise CheckpointError(
            f"block: {kind} {wrong} does not fit the config; it was changed since the block was trained"
        )
    module.load_state_dict(own, assign=True)


class BlockCache(Members):
    """Blocks of a run, fetched as they are asked for, the last used first; the surroundings always at hand.

    At most `limit` bytes of them stay, one at least.
    """

    def __init__(
        self, root: Path, cells: Sequence[Cell], around: Member, *, device: torch.device, limit: int | None
    ) -> None:
        self.root = root
        self.cells = cells
        self.device = device
        self.held = (around,)
        self.verified: set[int] = set()
        self._here: OrderedDict[int, Member] = OrderedDict()
        size = sum(t.numel() * t.element_size() for t in around.state_dict().values())
        self.room = None if limit is None else max(1, limit // size - 1)

    @property
    def here(self) -> tuple[int, ...]:
        """Blocks in memory, the least recently used first."""
        return tuple(self._here)

    def member(self, number: int) -> Member:
        """A block by its number; the surroundings come after the last one. Raises CheckpointError for a
        missing block.
        """
        if number == len(self.cells):
            return self.held[0]
        if number in self._here:
            self._here.move_to_end(number)
            return self._here[number]
        # Make room first, so that no more than the limit is ever in memory; checksums are looked at once.
        while self.room is not None and len(self._here) >= self.room:
            self._here.popitem(last=False)
        member = copy.deepcopy(self.held[0])
        member.chart = chart_of(self.cells[number])
        _, tensors = load_finished(folder_of(self.root, number), verify=number not in self.verified)
        restore(member, "member", tensors)
        self.verified.add(number)
        self._here[number] = member.requires_grad_(False).to(self.device).eval()
        return member


def load_blocked(
    root: Path, config: TrainConfig, facts: Facts, device: torch.device, max_memory: float | None
) -> tuple[Model, int, float]:
    """The blended model of a run's blocks, the steps of the one trained least, and the seconds of all
    together.

    Blocks are fetched as they are met; at most `max_memory` MiB of them stay. Raises CheckpointError where
    one is missing.
    """
    # The surroundings stay in memory, with the decoder, tones and poses that all blocks have in common.
    cells = load_blocks(root)
    around = surroundings(config, facts, cells)
    whole, tensors = load_finished(folder_of(root, WHOLE))
    around.restore(tensors)
    # Blocks are fetched when a ray meets them.
    limit = None if max_memory is None else int(max_memory * _MIB)
    cache = BlockCache(root, cells, around.member.to(device), device=device, limit=limit)
    model = assemble(
        config, facts, cache, BlendRouter(cells), around.model.decoder, around.model.tones, around.model.poses
    )
    model.requires_grad_(False)
    done = []
    for block in range(len(cells)):
        done.append(load_finished(folder_of(root, block), verify=False)[0])
    return (
        model.to(device).eval(),
        min(each.step for each in done),
        whole.seconds + sum(each.seconds for each in done),
    )


class Blocks(Partition):
    """A scene that is ready to be trained block by block."""

    def __init__(
        self, config: TrainConfig, scene: ParsedScene, plan: Plan, facts: Facts, basis: Basis | None
    ) -> None:
        self.config = config
        self.scene = scene
        self.plan = plan
        self.basis = basis
        self._facts = facts

    @property
    def facts(self) -> Facts:
        return self._facts

    def train(self, run: Run, display: Display, *, spent: float) -> None:
        """The surroundings, the blocks, largest first, and the style of the whole. Finished ones stay."""
        config = self.config
        scene = self.scene
        self.write(run)
        display.say(f"{len(self.plan.cells)} blocks and their surroundings")
        executor = config.executor.on(device_of(config.device).type).build()
        order = self.plan.rays.argsort(descending=True).tolist()
        train_all(
            config, run, executor, open_block, order, whole_share=SHARE, spent=spent, quiet=display.quiet
        )
        finish(
            run,
            display,
            config,
            load_blocked(run.root, config, self.facts, device_of(config.device), None)[0],
            scene,
        )

    def write(self, run: Run) -> None:
        """Write all that tasks read. Blocks that were trained as what another number is now are moved
        there.
        """
        plan = self.plan
        if self.basis is not None:
            run.save_tensors("basis", self.basis.tensors())
        # The views that see a block, and the tiles of them whose rays meet it; the surroundings learn from
        # everything.
        rays = {}
        for block in (WHOLE, *range(len(plan.cells))):
            if block == WHOLE:
                views = plan.views
            else:
                views = plan.views_of(block)
            at = torch.isin(plan.views, views)
            if block == WHOLE:
                seen = torch.ones_like(plan.seen[at, 0])
            else:
                seen = plan.seen[at, block]
            rays[block] = {"views": views, "seen": seen.to(torch.uint8)}
        folder = folder_of(run.root, 0).parent
        if any(task_of(part) for part in folder.glob("*")):  # digests read all images
            blocks = range(len(plan.cells))
            asked = {}
            for z in blocks:
                asked[z] = block_task(self.config, self.facts, self.scene, plan.cells, z, rays[z])["task"]
            renumber(folder, asked)
        for block, own in rays.items():
            folder_of(run.root, block).mkdir(parents=True, exist_ok=True)
            tensorfiles.save(folder_of(run.root, block) / RAYS, own)
        write_cells(run.root / "blocks.json", plan.cells)


def block_task(
    config: TrainConfig,
    facts: Facts,
    scene: ParsedScene,
    cells: Sequence[Cell],
    block: int,
    rays: dict[str, Tensor],
) -> dict[str, Any]:
    """The task of a block, and how long it is trained (`Part.asked`). `rays` is its rays.safetensors.

    A block is decided by its bounds and rays, its images, and the config but for what may change, not by its
    surroundings: they are only its frame.
    """
    # What the surroundings span follows from all blocks together, not from how they are cut.
    if block == WHOLE:
        chart = surroundings_of(cells)
    else:
        chart = chart_of(cells[block])
    views = rays["views"].tolist()
    space = facts.space
    parts = {
        "bounds": [chart.low.tolist(), chart.high.tolist(), torch.eye(3).tolist()],
        "space": [space.centre, space.rotation, space.scale, space.near, space.far],
        "views": views,
        "facts": [
            facts.of_field.channels,
            facts.of_field.dim,
            facts.of_field.content_encoder,
            facts.of_field.semantic_encoder,
            facts.background,
            facts.exposure,
        ],
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
    scene: ParsedScene
    facts: Facts
    rays: dict[str, Tensor]

    def build(self) -> FieldLearner:
        """A block inside of its finished surroundings, on its own views and pixels; features are in the
        cache.
        """
        config = self.config
        facts = self.facts
        scene = replace(self.scene, train=self.rays["views"])
        lead = 0
        built = surroundings(config, facts, load_blocks(self.run.root))
        if self.block != WHOLE:
            done, tensors = load_finished(folder_of(self.run.root, WHOLE))
            built.restore(
                {name: tensor.clone() for name, tensor in tensors.items()}
            )  # training writes to them
            built.member.requires_grad_(True)
            built = block_in_surroundings(
                config, facts, load_blocks(self.run.root)[self.block], built, self.rays["views"]
            )
            # Its sampler goes on where that of the surroundings stopped.
            lead = done.step
            config = replace(
                config, optimizer=replace(config.optimizer, warm_up=min(config.optimizer.warm_up, WARM_UP))
            )
        # Its pixels are those of the tiles that meet it; the basis of the semantics is the whole scene's.
        slots = {view: slot for slot, view in enumerate(self.rays["views"].tolist())}

        def seen(view: int) -> Tensor:
            width, height = scene.cameras.size[view].tolist()
            return pixel_mask(self.rays["seen"][slots[view]].bool(), (width, height))

        basis = None
        if facts.of_field.dim:
            basis = Basis.from_tensors(self.run.load_tensors("basis"))
        prepared = prepare(config, scene, facts, space=facts.space, basis=basis, seen=seen)._replace(
            facts=facts
        )
        return FieldLearner(config, prepared, device_of(config.device), built.model, lead=lead)

    def keep(self, learner: Learner) -> dict[str, Any]:
        """Write the block's fields, and what was learnt with them."""
        assert isinstance(learner, FieldLearner) and isinstance(
            learner.model.field, BlockedField
        )  # it is that of `build`
        built = Built(learner.model, learner.model.field.members.held[0])
        tensors = {}
        for kind, part in built.kept().items():
            for name, t in part.state_dict().items():
                tensors[f"{kind}.{name}"] = t
        return tensorfiles.save(self.folder / FILE, tensors)


def open_block(task: Task) -> Block:
    """The block of a task. Raises ConfigError where the images are not those of the run."""
    root = Path(task.root)
    block = task.part
    # All but its number and its share of the time is read from the run folder.
    run = Run(root)
    folder = folder_of(root, block)
    config = fields_only(run.load_config()[0], root)
    facts = run.load_known().facts
    # A worker may see the scene at another path; views are numbers, so it must be the same scene.
    scene = read_scene(replace(config, data=Path(task.data)), facts)
    rays = tensorfiles.read(folder / RAYS)
    if len(rays["views"]) and int(rays["views"].max()) >= len(scene.paths):
        raise ConfigError(
            f"{folder}: its views are not those of {scene.name}; train with the scene that the run was cut from"
        )
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
