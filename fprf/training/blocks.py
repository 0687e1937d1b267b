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
import json
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor, nn

from ..blocks.fields import BlockedField, BlockedSampler, BlockedSemantic, Held, Member, Members, inherit
from ..blocks.routing import Chart, Everywhere, Inset, Router, chart_of, surroundings_of
from ..config import TrainConfig
from ..errors import CheckpointError
from ..interfaces import Decoder
from ..io.atomic import write_json
from ..rendering.renderer import Parts
from ..types import Boxes
from . import tensorfiles
from .decoder import build_decoder
from .first_use import check_parts
from .model import Facts, Model, poses_of, tones_of
from .poses import Poses
from .tones import Tones

__all__ = [
    "SURROUNDINGS",
    "Built",
    "Finished",
    "assemble",
    "folder_of",
    "inset",
    "load_finished",
    "member_of",
    "read_done",
    "restore",
    "save_finished",
    "surroundings",
]

SURROUNDINGS = -1
"""The number of what no block holds."""
_FORMAT = 1


class Built(NamedTuple):
    """A model to train, and the member of it that is kept."""

    model: Model
    member: Member


class Finished(NamedTuple):
    """What done.json says of a block."""

    step: int
    seconds: float
    tensors: dict[str, Tensor]


def folder_of(root: Path, block: int) -> Path:
    """Where a block lies in a run."""
    return root / "blocks" / ("surroundings" if block == SURROUNDINGS else f"{block:02d}")


def member_of(config: TrainConfig, facts: Facts, chart: Chart) -> Member:
    """Fields and sampler of a block at their seeded start."""
    return Member(
        chart,
        config.sampler.build(seed=config.seed),
        config.content.field.build(channels=facts.channels, seed=config.seed + 1),
        config.semantic.field.build(channels=facts.dim, seed=config.seed + 2) if facts.dim else None,
    )


def assemble(
    config: TrainConfig,
    facts: Facts,
    members: Members,
    router: Router,
    decoder: Decoder,
    tones: Tones | None,
    poses: Poses | None = None,
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


def surroundings(config: TrainConfig, facts: Facts, boxes: Boxes) -> Built:
    """The coarse scene that everything starts from. Raises PluginError where a part breaks its contract at once."""
    decoder = build_decoder(config, encoder=facts.content_encoder, channels=facts.channels)
    member = member_of(config, facts, surroundings_of(boxes))
    model = assemble(config, facts, Held([member]), Everywhere(), decoder, tones_of(facts), poses_of(config, facts))
    check_parts(config, model.parts, facts.channels, facts.dim)
    return Built(model, member)


def inset(
    config: TrainConfig, facts: Facts, boxes: Boxes, block: int, around: Built, views: Annotated[Tensor, "M"] | None = None
) -> Built:
    """A block inside of a copy of its surroundings; decoder and tones are theirs, as they learnt them.

    Poses start as theirs too, and are refined further from the `views` that the block learns from.
    """
    chart = chart_of(boxes, block)
    member = member_of(config, facts, chart)
    inherit(member, around.member)
    decoder = copy.deepcopy(around.model.decoder).requires_grad_(False)
    tones = copy.deepcopy(around.model.tones)
    held = Held([member, copy.deepcopy(around.member)])
    still = None if tones is None else tones.requires_grad_(False)
    poses = around.model.poses
    if poses is not None:
        others = set(range(len(facts.centres))) - set([] if views is None else views.tolist())
        poses = poses.going_on(torch.tensor(facts.centres, dtype=torch.float64), tuple(sorted(others)))
    return Built(assemble(config, facts, held, Inset(chart), decoder, still, poses), member)


def save_finished(folder: Path, built: Built, *, asked: dict[str, Any], step: int, seconds: float) -> None:
    """Write the kept member and the decoder, then that the block is done."""
    tensors = {f"member.{name}": t for name, t in built.member.state_dict().items()}
    tensors |= {f"decoder.{name}": t for name, t in built.model.decoder.state_dict().items()}
    if built.model.tones is not None:
        tensors |= {f"tones.{name}": t for name, t in built.model.tones.state_dict().items()}
    if built.model.poses is not None:
        tensors |= {f"poses.{name}": t for name, t in built.model.poses.state_dict().items()}
    manifest = tensorfiles.save(folder / "block.safetensors", tensors)
    write_json(folder / "done.json", {"format": _FORMAT, "asked": asked, "step": step, "seconds": seconds, "tensors": manifest})


def read_done(folder: Path) -> dict[str, Any] | None:
    """done.json, or None where the block is not finished."""
    try:
        document: dict[str, Any] = json.loads((folder / "done.json").read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as e:
        raise CheckpointError(f"{folder / 'done.json'}: cannot be read ({e}); remove it and train again") from e
    return document if document.get("format") == _FORMAT else None


def load_finished(folder: Path, *, verify: bool = True) -> Finished:
    """The tensors of a finished block, memory-mapped; verifying reads them all. Raises CheckpointError."""
    done = read_done(folder)
    if done is None:
        again = f"fprf train {folder.parent.parent / 'config.json'}"
        raise CheckpointError(f"{folder}: this block is not finished; go on with `{again}`")
    try:
        step, seconds, manifest = int(done["step"]), float(done["seconds"]), dict(done["tensors"])
    except (KeyError, TypeError, ValueError) as e:
        raise CheckpointError(f"{folder / 'done.json'}: cannot be read ({e!r}); remove it and train again") from e
    file = folder / "block.safetensors"
    return Finished(step, seconds, tensorfiles.load(file, manifest) if verify else tensorfiles.read(file))


def restore(module: nn.Module, kind: str, tensors: dict[str, Tensor]) -> None:
    """Give a `member`, `decoder`, `tones` or `poses` its tensors of a finished block: mapped from the file, not copied."""
    own = {name.removeprefix(f"{kind}."): t for name, t in tensors.items() if name.startswith(f"{kind}.")}
    now = module.state_dict()
    wrong = [name for name, t in now.items() if name not in own or own[name].shape != t.shape]
    wrong += [name for name in own if name not in now]
    if wrong:
        raise CheckpointError(f"block: {kind} {wrong[0]} does not fit the config; it was changed since the block was trained")
    module.load_state_dict(own, assign=True)
