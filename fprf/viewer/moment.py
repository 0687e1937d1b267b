"""A run in the middle of its training: its model without a checkpoint, and its style before training has measured it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.basis import Basis
from ..errors import CheckpointError
from ..style.matching import unit
from ..style.references import Encoders
from ..style.scene import SceneStyle
from ..training import tensorfiles
from ..training.block_task import built_block
from ..training.blocks import folder_of
from ..training.lay_out import RAYS, load_boxes
from ..training.loading import Trained, encoders_of
from ..training.model import build_model
from ..training.prepare import device_of
from ..training.run import Run
from ..training.style_pass import measure_style

__all__ = ["begun", "encoders_now", "filled", "likest"]

_RAYS = 2**14
"""Rays that the style of a moment is measured with: 0.2 s instead of seconds, and it changes soon."""


def begun(root: Path, device: str, block: int | None = None) -> Trained:
    """A run whose config.json and scene.json are written, with its model, or that of a block in its surroundings, at its start.

    Raises CheckpointError.
    """
    run = Run(root)
    saved, method = run.load_config()
    config = saved.fields_only(root)
    known = run.load_known()
    if block is None:
        model = build_model(config, known.facts)
    else:
        views = tensorfiles.read(folder_of(root, block) / RAYS)["views"]
        model = built_block(root, config, known.facts, load_boxes(root), block, views).model
    model.requires_grad_(False)
    return Trained(run, config, method, known, model.to(device_of(device)).eval(), 0, 0.0)


def filled(trained: Trained, tensors: Mapping[str, Tensor]) -> Trained:
    """The run with other numbers in its model. Raises CheckpointError where they are not of this model."""
    try:
        trained.model.load_state_dict(dict(tensors))
    except RuntimeError as error:
        raise CheckpointError(f"{trained.run.root}: its parameters are not those of its config ({error})") from error
    return trained


def encoders_now(trained: Trained, before: Encoders | None) -> Encoders:
    """The encoders with the scene's style as it is now; those that were opened `before` are kept.

    Raises DataError where the scene renders empty still, NumericsError where its features are not finite.
    """
    config, known = trained.config, trained.known
    few = replace(config, statistics=replace(config.statistics, rays=min(_RAYS, config.statistics.rays)))
    scene = measure_style(few, trained.model, known.cameras, torch.tensor(known.train))
    if before is not None:
        return before._replace(scene=scene)
    basis = None if scene.keys.shape[1] == 0 else Basis.from_tensors(trained.run.load_tensors("basis"))
    return encoders_of(trained, scene, basis)


def likest(before: SceneStyle, now: SceneStyle) -> Annotated[Tensor, "K"]:
    """For each region from before the one that is most like it now: regions are found anew, in any order."""
    if before.keys.shape[1] == 0:
        return torch.zeros(len(before.keys), dtype=torch.int64)
    scores = unit(before.keys, before.semantic_mean) @ unit(now.keys, now.semantic_mean).T
    return scores.argmax(-1)
