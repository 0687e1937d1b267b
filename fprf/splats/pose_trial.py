"""Find out by some photographs whether the poses that a capture gives are off.

The scene as learnt so far stays as it is. Each of some views that it was not learnt from is moved to where
three quarters of its pixels fit best, and judged on the last quarter. Where poses are right, the scene shows
such a view best from there. Where each is off by a little, the scene is what the others agree on, and the view
moves towards that.
"""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..ops.rasterise.gsplat import Trainable
from ..ops.rasterise.training import Floats, Target
from ..training.camera_optimizers import rotated
from .view_corrections import AdamState

_BLOCK_PIXELS = 16
"""Side of the blocks of which each fourth is left out: smaller ones would be told by their neighbours."""
_STEPS = 40
"""Steps of each view: after 24 poses still tremble, and llff_flower gains 0.01 dB in place of 0.12."""
_RATE = 1e-3
"""Radians, and distances that views commonly see, of the first step; by eye."""
_FINAL_RATE_SHARE = 0.1
"""Share of it that is left at the last; by eye."""


def trial_gain(
    model: Trainable,
    targets: Sequence[Target],
    factors: Sequence[Annotated[Floats, "3"] | None],
    *,
    background: tuple[float, float, float],
    ssim: float,
    reach: float,
) -> float:
    """Decibels that left-out pixels of some views gain when the others find their poses; 0 where none counts.

    `model` keeps its Gaussians, not their moments; `factors` are those of the views' colours.
    """
    rates = np.zeros(model.rows, np.float32)
    before = 0.0
    after = 0.0
    for target, factor in zip(targets, factors, strict=True):
        judged = left_out_blocks(target.width, target.height)
        kept = target.limited_to(~judged)
        left = target.limited_to(judged)
        move = AdamState.beginning(torch.zeros(1, 6, dtype=torch.float64))

        def measured(target: Target, factor: Annotated[Floats, "3"] | None) -> float:
            found = model.learn(target, background=background, ssim=ssim, rates=rates, factors=factor)
            return found.squared

        first = measured(left, factor)
        for step in range(_STEPS):
            moved = _moved(kept, move.value[0], reach)
            found = model.learn(moved, background=background, ssim=ssim, rates=rates, factors=factor)
            gradient = torch.from_numpy(found.of_camera)
            slope = torch.cat([torch.from_numpy(moved.axes).T @ gradient[:3], reach * gradient[3:]])
            move.row(0).step(slope, _RATE * _FINAL_RATE_SHARE ** (step / _STEPS))
        last = measured(_moved(left, move.value[0], reach), factor)
        # Views whose left-out pixels all do not count have nothing to say.
        if math.isfinite(first + last):
            before += first
            after += last
    if before <= 0 or after <= 0:
        return 0.0
    return 10 * math.log10(before / after)


def left_out_blocks(width: int, height: int) -> Annotated[NDArray[np.bool_], "H W"]:
    """Mask of a quarter of an image: one of each 2 x 2 blocks."""
    down = np.arange(height) // _BLOCK_PIXELS % 2 == 1
    across = np.arange(width) // _BLOCK_PIXELS % 2 == 1
    mask: NDArray[np.bool_] = np.logical_and.outer(down, across)
    return mask


def _moved(target: Target, move: Annotated[Tensor, "6"], reach: float) -> Target:
    axes = rotated(torch.from_numpy(target.axes), move[:3].expand(3, 3))
    return target.seen_from(axes.numpy(), target.centre + reach * move[3:].numpy())
