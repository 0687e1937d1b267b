"""From the space of a scene to the unit cube of one of its blocks, or of its surroundings.

A block's chart is affine: its cell with the margin fills the cube, so that no node of its planes lies where it has no say.
The chart of the surroundings contracts: all blocks together fill the inner half, everything else the rest.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..rendering.space import contract
from ..types import Boxes
from .windows import aligned, local

__all__ = ["Chart", "chart_of", "surroundings_of"]


@dataclass(frozen=True)
class Chart:
    """Where low becomes -1 and high becomes 1 (or, contracted, -1/2 and 1/2), in turned axes."""

    low: Annotated[Tensor, "3"]
    high: Annotated[Tensor, "3"]
    turn: Annotated[Tensor, "3 3"]
    contracted: bool = False

    def locate(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Points of the space to the cube; a block's chart takes those inside its box alone to points inside the cube."""
        there = self._placed(points)
        x = local(points, there.turn)
        # The middle is taken off before anything is scaled: float32 keeps what is left of a large coordinate.
        y = (x - there.middle) / there.half
        return contract(y) if self.contracted else y

    def inside(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """Whether points lie in the box."""
        there = self._placed(points)
        x = local(points, there.turn)
        return ((x >= there.low) & (x <= there.high)).all(-1)

    @cached_property
    def _numbers(self) -> "dict[tuple[torch.dtype, torch.device], _Placed]":
        return {}

    def _placed(self, points: Tensor) -> "_Placed":
        """The chart's tensors with the dtype and device of points, copied once, not in each training step."""
        key = (points.dtype, points.device)
        if key not in self._numbers:
            with torch.inference_mode(False):
                middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
                turn = None if aligned(self.turn) else self.turn.to(points)
                self._numbers[key] = _Placed(turn, *(x.to(points) for x in (middle, half, self.low, self.high)))
        return self._numbers[key]


class _Placed(NamedTuple):
    turn: Tensor | None
    """None for the axes of the space."""
    middle: Tensor
    half: Tensor
    low: Tensor
    high: Tensor


def chart_of(boxes: Boxes, block: int) -> Chart:
    """The chart of a block: its cell and the margin around it."""
    return Chart(boxes.low[block] - boxes.margin, boxes.high[block] + boxes.margin, boxes.turn[block])


def surroundings_of(boxes: Boxes) -> Chart:
    """The chart of what no block holds: contracted around the bounds of all blocks, in the axes of the space."""
    bits = (torch.arange(8)[:, None] >> torch.arange(3)) & 1
    ends = torch.stack([boxes.low, boxes.high], 1)
    corners = torch.stack([ends[:, bits[:, a], a] for a in range(3)], -1)
    world = corners @ boxes.turn
    flat = world.reshape(-1, 3)
    return Chart(flat.amin(0), flat.amax(0), torch.eye(3, dtype=boxes.low.dtype), contracted=True)
