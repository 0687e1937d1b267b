"""How much each block has to say at a point: smooth windows that sum to 1 where cells meet.

A block reaches a margin m beyond its cell. Along each axis its window rises by a smoothstep from 0 on the border of that reach
to 1 two margins inside, so it is 1/2 on the cell's face; neighbours that share a face have windows S and 1 - S there. Where
windows sum to less than 1 the surroundings have the rest; where cells overlap (bends) they sum to more and are scaled. The
weights are continuous, and so is whatever is blended by them.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..types import Boxes

__all__ = ["aligned", "local", "shares", "window"]


def aligned(turn: Annotated[Tensor, "3 3"]) -> bool:
    """Return whether axes are those of the space."""
    return bool((turn == torch.eye(3, dtype=turn.dtype, device=turn.device)).all())


def local(points: Annotated[Tensor, "N 3"], turn: Annotated[Tensor, "3 3"] | None) -> Annotated[Tensor, "N 3"]:
    """Points in the axes of a cell; None = those of the space."""
    if turn is None or (turn.device.type == "cpu" and aligned(turn)):
        return points
    turn = turn.to(points)
    if points.device.type == "cpu":
        return points @ turn.T
    # No product of matrices: in TF32 a coordinate would be off by a two thousandth of itself.
    return (points[:, None] * turn).sum(-1)


def window(points: Annotated[Tensor, "N 3"], boxes: Boxes, block: int) -> Annotated[Tensor, "N"]:
    """Window of a block at points of the space, in [0, 1]; without a margin it is that of the bare cell."""
    x = local(points, boxes.turn[block])
    low, high = boxes.low[block].to(x), boxes.high[block].to(x)
    if boxes.margin <= 0:
        return ((x >= low) & (x <= high)).all(-1).to(x)
    # Distances are taken from the face before they are divided: a large scene must not lose them.
    rise = torch.minimum(x - low, high - x) / (2 * boxes.margin) + 0.5
    rise = rise.clamp(0, 1)
    return (rise * rise * (3 - 2 * rise)).prod(-1)


def shares(points: Annotated[Tensor, "N 3"], boxes: Boxes) -> Annotated[Tensor, "N Z+1"]:
    """Weight of every block at every point, the surroundings last; rows are at least 0 and sum to 1."""
    if not len(boxes.low):
        return points.new_ones(len(points), 1)
    windows = torch.stack([window(points, boxes, block) for block in range(len(boxes.low))], -1)
    total = windows.sum(-1, keepdim=True)
    return torch.cat([windows / total.clamp_min(1), (1 - total).clamp_min(0)], -1)
