"""Scenes of blocks: models of one block for training, folders, tasks that can be run anywhere and again.

    RUN/blocks.json              the cut: boxes, rays and views of each block
    RUN/blocks/NN/rays.safetensors      views and tiles that block NN learns from
    RUN/blocks/NN/task.json      what the block is trained as; another one starts it anew
    RUN/blocks/NN/checkpoints/, events.jsonl       as of any run
    RUN/blocks/NN/block.safetensors, done.json     the finished fields, and that they are
    RUN/blocks/surroundings/     the same for what no block holds

The surroundings are trained first, on everything: a coarse scene. A block is trained inside of a copy of them, which goes on
learning with it and is then dropped: so each ray is whole while a block learns its part, and what the block cannot explain
does not end up as a veil in it. The block itself starts as what they have learnt of its place (`blocks.inherit`): a street of
four blocks came out 1.9 dB better after 200 steps each than from seeded planes.
"""

import copy
import hashlib
import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor, nn

from ..blocks.fields import BlockedField, BlockedSampler, BlockedSemantic, Held, Member, Members, inherit
from ..blocks.partition import read_cells
from ..blocks.routing import Everywhere, Inset, Router, chart_of, surroundings_of
from ..config import FREE_IN_BLOCKS, TrainConfig
from ..datamanagers.scene import Scene
from ..errors import CheckpointError
from ..interfaces import Decoder
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..plugins.codec import from_json, to_json
from ..rendering.renderer import Parts
from ..testing.outputs import check_parts
from ..types import Cell
from . import tensorfiles
from .camera_optimizers import Poses, Tones
from .checkpoint import misfit
from .model import Facts, Model, build_decoder, build_fields, poses_of, tones_of

RAYS = "rays.safetensors"
"""In a block's folder: the views and tiles that it learns from."""
SURROUNDINGS = -1
"""The number of what no block holds."""
_FORMAT = 1


class Built(NamedTuple):
    """A model to train, and the member of it that is kept."""

    model: Model
    member: Member


@dataclass(frozen=True, kw_only=True)
class Done:
    """Content of a block's done.json."""

    format: int
    asked: dict[str, Any]
    """See `asked_of`."""
    step: int
    seconds: float
    tensors: dict[str, Any]
    """Manifest of block.safetensors."""


class Finished(NamedTuple):
    """A finished block."""

    step: int
    seconds: float
    tensors: dict[str, Tensor]


def folder_of(root: Path, block: int) -> Path:
    """Folder of a block in a run."""
    return root / "blocks" / ("surroundings" if block == SURROUNDINGS else f"{block:02d}")


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
    return Model(
        Parts(
            facts.space,
            BlockedSampler(config.sampler.build(seed=config.seed), members, router),
            BlockedField(members, router),
            BlockedSemantic(members, router) if facts.dim else None,
            decoder,
        ),
        tones,
        poses,
    )


def surroundings(config: TrainConfig, facts: Facts, cells: Sequence[Cell]) -> Built:
    """The coarse scene that everything starts from. Raises PluginError where a part breaks its contract at once."""
    decoder = build_decoder(config, encoder=facts.content_encoder, channels=facts.channels)
    member = Member(surroundings_of(cells), *build_fields(config, facts))
    model = assemble(config, facts, Held([member]), Everywhere(), decoder, tones_of(facts), poses_of(config, facts))
    check_parts(config, model.parts, facts.channels, facts.dim)
    return Built(model, member)


def inset(
    config: TrainConfig,
    facts: Facts,
    cells: Sequence[Cell],
    block: int,
    around: Built,
    views: Annotated[Tensor, "M"] | None = None,
) -> Built:
    """A block inside of a copy of its surroundings; decoder and tones are theirs, as they learnt them.

    Poses start as theirs too, and are refined further from the `views` that the block learns from.
    """
    chart = chart_of(cells[block])
    member = Member(chart, *build_fields(config, facts))
    inherit(member, around.member)
    decoder = copy.deepcopy(around.model.decoder).requires_grad_(False)
    tones, poses = copy.deepcopy(around.model.tones), around.model.poses
    if tones is not None:
        tones.requires_grad_(False)
    if poses is not None:
        others = set(range(len(facts.centres))) - set([] if views is None else views.tolist())
        poses = poses.going_on(torch.tensor(facts.centres, dtype=torch.float64), tuple(sorted(others)))
    members = Held([member, copy.deepcopy(around.member)])
    return Built(assemble(config, facts, members, Inset(chart), decoder, tones, poses), member)


def _kept(built: Built) -> dict[str, nn.Module]:
    """Parts that stay when a block is finished, by their names in its file."""
    model = built.model
    parts = {"member": built.member, "decoder": model.decoder, "tones": model.tones, "poses": model.poses}
    return {kind: part for kind, part in parts.items() if part is not None}


def save_finished(folder: Path, built: Built, *, asked: dict[str, Any], step: int, seconds: float) -> None:
    """Write the kept member and the decoder, then that the block is done."""
    tensors = {f"{kind}.{name}": t for kind, part in _kept(built).items() for name, t in part.state_dict().items()}
    manifest = tensorfiles.save(folder / "block.safetensors", tensors)
    write_json(folder / "done.json", {"format": _FORMAT, "asked": asked, "step": step, "seconds": seconds, "tensors": manifest})


def read_done(folder: Path) -> Done | None:
    """done.json, or None where the block is not finished. Raises CheckpointError."""
    file = folder / "done.json"
    if not file.is_file():
        return None
    with open_json(file, "remove it and train again") as document:
        return from_json(document, Done, path="done") if document["format"] == _FORMAT else None


def load_finished(folder: Path, *, verify: bool = True) -> Finished:
    """The tensors of a finished block, memory-mapped; verifying reads them all. Raises CheckpointError."""
    done = read_done(folder)
    if done is None:
        again = f"fprf train {folder.parent.parent / 'config.json'}"
        raise CheckpointError(f"{folder}: this block is not finished; go on with `{again}`")
    file = folder / "block.safetensors"
    return Finished(done.step, done.seconds, tensorfiles.load(file, done.tensors) if verify else tensorfiles.read(file))


def restore(module: nn.Module, kind: str, tensors: dict[str, Tensor]) -> None:
    """Give a `member`, `decoder`, `tones` or `poses` its tensors of a finished block: mapped from the file, not copied."""
    own = {name.removeprefix(f"{kind}."): t for name, t in tensors.items() if name.startswith(f"{kind}.")}
    wrong = misfit(module, own)
    if wrong is not None:
        raise CheckpointError(f"block: {kind} {wrong} does not fit the config; it was changed since the block was trained")
    module.load_state_dict(own, assign=True)


def restore_all(built: Built, tensors: dict[str, Tensor]) -> None:
    """Give a member and the rest of its model the tensors of a finished block."""
    for kind, part in _kept(built).items():
        restore(part, kind, tensors)


def load_blocks(root: Path) -> list[Cell]:
    """Read the boxes of a run's blocks. Raises CheckpointError."""
    return read_cells(root / "blocks.json")


def asked_of(
    config: TrainConfig, facts: Facts, scene: Scene, cells: Sequence[Cell], block: int, rays: dict[str, Tensor]
) -> dict[str, Any]:
    """Settings and data of a block's training; while they stay the same, the block stays valid. `rays` is its rays.safetensors.

    A block is decided by its bounds and rays, its images, and the config but for what may change, not by its surroundings:
    they are only its frame.
    """
    tree = to_json(config)
    assert isinstance(tree, dict)
    knobs = {name: value for name, value in tree.items() if name not in FREE_IN_BLOCKS}
    views = rays["views"].tolist()
    # What the surroundings span follows from all blocks together, not from how they are cut.
    chart = surroundings_of(cells) if block == SURROUNDINGS else chart_of(cells[block])
    parts = {
        "config": knobs,
        "bounds": [chart.low.tolist(), chart.high.tolist(), torch.eye(3).tolist()],
        "space": [facts.space.centre, facts.space.rotation, facts.space.scale, facts.space.near, facts.space.far],
        "views": views,
        "cameras": [scene.cameras.pose[views].tolist(), scene.cameras.focal[views].tolist()],
        "facts": [facts.channels, facts.dim, facts.content_encoder, facts.semantic_encoder, facts.background, facts.exposure],
    }
    digest = hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode() + rays["seen"].numpy().tobytes())
    for view in views:
        digest.update(zlib.crc32(scene.paths[view].read_bytes()).to_bytes(4, "little"))
    return {"task": digest.hexdigest()[:32], "steps": config.steps, "minutes": config.minutes}


def built_block(root: Path, config: TrainConfig, facts: Facts, cells: Sequence[Cell], block: int, views: Tensor) -> Built:
    """The model of a block, inside of its finished surroundings."""
    around = surroundings(config, facts, cells)
    if block == SURROUNDINGS:
        return around
    finished = load_finished(folder_of(root, SURROUNDINGS)).tensors
    own = {name: tensor.clone() for name, tensor in finished.items()}  # training writes to them, the file stays
    restore_all(around, own)
    around.member.requires_grad_(True)
    return inset(config, facts, cells, block, around, views)
