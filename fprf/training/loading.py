"""A trained run, ready to render."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from ..blocks.routing import Blend
from ..config import TrainConfig
from ..datamanagers.basis import Basis
from ..errors import CheckpointError
from ..style.scene import SceneStyle, from_tensors
from . import checkpoint
from .blocks import SURROUNDINGS, assemble, folder_of, load_finished, read_done, restore, surroundings
from .lay_out import load_boxes
from .model import Model, build_model
from .prepare import device_of
from .run import Known, Run
from .shelf import Shelf

__all__ = ["Trained", "load_run", "load_style"]


_MIB = 1 << 20


class Trained(NamedTuple):
    """One run in memory."""

    run: Run
    config: TrainConfig
    method: str
    known: Known
    model: Model
    step: int
    seconds: float
    """How long it was trained."""
    damaged: tuple[str, ...] = ()
    """A line for each newer checkpoint that could not be used."""


def load_run(root: Path, device: str = "auto", max_memory: float | None = None) -> Trained:
    """Rebuild a run's model from its folder alone. Raises CheckpointError with what is missing and what to do.

    Blocks of a large scene are fetched as they are met; at most `max_memory` MiB of them stay (one at least).
    """
    run = Run(root)
    saved_config, method = run.load_config()
    config = saved_config.fields_only(root)
    known = run.load_known()
    if known.facts.space.kind == "open":
        return _load_blocks(run, config, method, known, device_of(device), max_memory)
    saved, damaged = checkpoint.load_latest(run.checkpoints)
    if saved is None:
        raise CheckpointError(f"{root}: no checkpoint yet; go on with `fprf train {root / 'config.json'} --output {root}`")
    model = build_model(config, known.facts)
    checkpoint.restore(saved, model, None)
    model.requires_grad_(False)
    model = model.to(device_of(device)).eval()
    return Trained(run, config, method, _where_refined(known, model), model, saved.step, saved.seconds, tuple(damaged))


def _load_blocks(
    run: Run, config: TrainConfig, method: str, known: Known, device: torch.device, max_memory: float | None
) -> Trained:
    """The surroundings in memory, the blocks on a shelf."""
    boxes, facts = load_boxes(run.root), known.facts
    around = surroundings(config, facts, boxes)
    finished = load_finished(folder_of(run.root, SURROUNDINGS))
    restore(around.member, "member", finished.tensors)
    restore(around.model.decoder, "decoder", finished.tensors)
    if around.model.tones is not None:
        restore(around.model.tones, "tones", finished.tensors)
    if around.model.poses is not None:
        restore(around.model.poses, "poses", finished.tensors)
    limit = None if max_memory is None else int(max_memory * _MIB)
    shelf = Shelf(run.root, boxes, around.member.to(device), device=device, limit=limit)
    model = assemble(config, facts, shelf, Blend(boxes), around.model.decoder, around.model.tones, around.model.poses)
    model.requires_grad_(False)
    done = [read_done(folder_of(run.root, block)) for block in range(len(boxes.low))]
    steps = [int(each["step"]) for each in done if each is not None]
    seconds = finished.seconds + sum(float(each["seconds"]) for each in done if each is not None)
    if len(steps) < len(done):
        again = f"fprf train {run.root / 'config.json'}"
        raise CheckpointError(
            f"{run.root}: {len(done) - len(steps)} of {len(done)} blocks are not finished; go on with `{again}`"
        )
    return Trained(run, config, method, _where_refined(known, model), model.to(device).eval(), min(steps), seconds)


def _where_refined(known: Known, model: Model) -> Known:
    """What is known of the scene, its cameras where training has put them."""
    return known if model.poses is None else replace(known, cameras=model.poses.refined(known.cameras))


def load_style(run: Run) -> tuple[SceneStyle, Basis | None]:
    """The scene's own statistics, and its semantic basis (None without semantics)."""
    scene = from_tensors(run.load_tensors("style"))
    if scene.keys.shape[1] == 0:
        return scene, None
    return scene, Basis.from_tensors(run.load_tensors("basis"))
