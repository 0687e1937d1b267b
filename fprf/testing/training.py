"""Contracts of terms of the loss and executors of blocks."""

# A plug-in is asked whether it is of an abstract kind.
# mypy: disable-error-code="type-abstract"

import math

import torch
from torch import nn

from ..interfaces import Executor, LossTerm
from ..plugins.executors.config import ExecutorConfig
from ..plugins.losses.config import LossTermConfig
from ..rendering.renderer import TrainingStep, render_rays
from ..types import Batch, Rendered, Want
from . import cases
from .configs import built
from .outputs import Unread, follows, require, same, tensor


def check_loss_term(config: LossTermConfig) -> None:
    """A finite scalar with a gradient, a function of render, batch, step and generator, which reads no number
    of the device.
    """
    term, name = built(config, LossTerm, config.build)
    require(isinstance(term.needs, Want), f"{name}: needs must be a Want")
    parts = cases.parts()
    count = 6
    rendered = render_rays(
        cases.rays(count),
        parts,
        want=Want.DENSITY | term.needs,
        budget=0.0,
        training=TrainingStep(step=10, semantic_rays=count // 2),
    )
    assert rendered.weights is not None
    bare = cases.batch(count)._replace(content=None, semantic=None)

    def value(rendered: Rendered, batch: Batch, seed: int | None = None) -> torch.Tensor:
        generator = None
        if seed is not None:
            generator = torch.Generator().manual_seed(seed)
        return term(rendered, batch, parts, step=10, generator=generator)

    for batch, render in ((cases.batch(count), rendered), (bare, rendered._replace(semantic=None))):
        for seed in (None, 3):
            with Unread(name):
                loss = value(render, batch, seed)
            tensor(loss, (), f"{name}: the term")
            same(
                value(render, batch, seed),
                loss,
                0.0,
                f"{name}: must be a function of its inputs and the generator",
            )
    loss = value(rendered, cases.batch(count))
    require(loss.requires_grad, f"{name}: no gradient goes through the term")
    for gradient in torch.autograd.grad(
        loss, [p for m in parts if isinstance(m, nn.Module) for p in m.parameters()], allow_unused=True
    ):
        require(gradient is None or bool(gradient.isfinite().all()), f"{name}: its gradient is not finite")
    # At the beginning rays may meet nothing, or a wall at once: no term may divide by what is not there.
    nothing = torch.zeros_like(rendered.weights)
    for weights, kind in (
        (nothing, "that meet nothing"),
        (nothing.index_fill(1, torch.tensor([2]), 1.0), "that end at once"),
    ):
        weights.requires_grad_()
        loss = value(rendered._replace(weights=weights, opacity=weights.detach().sum(1)), cases.batch(count))
        tensor(loss, (), f"{name} of rays {kind}")
        moved = None
        if loss.requires_grad:
            moved = torch.autograd.grad(loss, weights, allow_unused=True)[0]
        require(
            moved is None or bool(moved.isfinite().all()),
            f"{name}: its gradient for rays {kind} is not finite",
        )
    follows(lambda: value(rendered, cases.batch(count)), rendered.weights, name)


def check_executor(config: ExecutorConfig) -> None:
    """Results in the order of the tasks; an error reaches the caller."""
    executor, name = built(config, Executor, config.build)
    require(
        executor.map(math.factorial, [5, 0, 3]) == [120, 1, 6],
        f"{name}: results must be in the order of the tasks",
    )
    require(executor.map(math.factorial, []) == [], f"{name}: no tasks, no results")
    try:
        executor.map(math.factorial, [1, -1])
    except ValueError:
        return
    raise AssertionError(f"{name}: an error in a task must reach the caller")
