"""A training step on its own: on a run's model, with its batches, at the place in the schedule where the run stands."""

from collections.abc import Callable

import torch
from torch import Tensor

from ..config import TrainConfig
from ..rendering.pixel_rays import PixelRays
from ..rendering.renderer import render_rays
from ..training.model import Model, background_of
from ..training.prepare import Prepared
from ..training.trainer import Loop, optimizer_of
from ..types import Batch, Rays, Want

__all__ = ["batch_rays", "colour_gradient", "loop_of", "stepper"]

SHARE = 0.5
"""Where in the learning-rate schedule a step is taken: halfway."""


def loop_of(config: TrainConfig, prepared: Prepared, model: Model) -> Loop:
    """The trainer's own loop around a model."""
    device = model.device
    return Loop(config, prepared, model, optimizer_of(config, model), device)


def stepper(loop: Loop, first: int) -> Callable[[], None]:
    """A call that takes the next step, from `first` on."""
    step = first

    def take() -> None:
        nonlocal step
        loop.step(step, SHARE)
        step += 1

    return take


def colour_gradient(model: Model, prepared: Prepared, config: TrainConfig, batch: Batch, rays: Rays, step: int) -> Tensor:
    """Gradient of the colour loss of a batch in all that the content field learns, flat.

    Samples are not jittered: draws in float32 and float64 would differ.
    """
    out = render_rays(
        rays,
        model.parts,
        want=Want.COLOUR,
        budget=config.render.train_budget,
        background=background_of(prepared.facts, rays.near.device),
        step=step,
    )
    assert out.rgb is not None
    loss = (out.rgb - batch.rgb.to(out.rgb)).square().mean()
    parameters = [p for p in model.field.parameters() if p.requires_grad]
    found = torch.autograd.grad(loss, parameters, allow_unused=True)
    return torch.cat([(torch.zeros_like(p) if g is None else g).flatten() for p, g in zip(parameters, found, strict=True)])


def batch_rays(model: Model, prepared: Prepared, batch: Batch) -> Rays:
    """Rays of a batch, on the model's device."""
    rays = model.space.rays(*PixelRays(prepared.scene.cameras)(batch.view.cpu(), batch.pixel.cpu()))
    return Rays(*(x.to(model.device) for x in rays))
