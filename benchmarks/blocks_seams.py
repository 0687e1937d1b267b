"""Jumps across the borders of blocks: pairs of parallel rays 1 mm apart, one on either side, against the same inside blocks.

Both rays of a pair run within the border's plane, so that every sample of one lies in one block's cell and every sample of
the other in its neighbour's: nothing but blending can make them agree.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from fprf.rendering.renderer import render_rays
from fprf.style.look import Restyle
from fprf.training.loading import Trained
from fprf.types import Boxes, Want

APART = 1e-3
"""World units between the two rays of a pair."""
Row = dict[str, float | int | str]


class Border(NamedTuple):
    """A face that two blocks share."""

    block: int
    axis: int
    middle: Tensor
    """[3] of the face, in the space."""


def borders(boxes: Boxes) -> list[Border]:
    """High faces along axes 0 and 1 of each block behind which another one begins."""
    found = []
    for block in range(len(boxes.low)):
        for axis in (0, 1):
            middle = (boxes.low[block] + boxes.high[block]) / 2
            middle[axis] = boxes.high[block, axis]
            beyond = middle.clone()
            beyond[axis] += 1e-6
            world = beyond @ boxes.turn[block]
            for other in range(len(boxes.low)):
                at = boxes.turn[other] @ world
                if other != block and bool(((at >= boxes.low[other] - 1e-9) & (at <= boxes.high[other] + 1e-9)).all()):
                    found.append(Border(block, axis, middle @ boxes.turn[block]))
                    break
    return found


def _pairs(trained: Trained, boxes: Boxes, border: Border, shift: float, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Origins on either side and directions, in the space: heights of cameras, level to a little up and down."""
    draw = torch.Generator().manual_seed(17 * border.block + border.axis)
    turn, unit = boxes.turn[border.block], 1 / trained.model.space.scale
    normal, along, up = turn[border.axis], turn[1 - border.axis], turn[2]
    half = (boxes.high - boxes.low)[border.block, 1 - border.axis] / 2
    space = trained.model.space
    pose = trained.known.cameras.pose[:, :, 3] - torch.tensor(space.centre, dtype=torch.float64)
    heights = (pose @ torch.tensor(space.rotation, dtype=torch.float64).T * space.scale)[:, 2]
    height = heights[torch.randint(len(heights), (count,), generator=draw)]
    across = (torch.rand(count, generator=draw).double() - 0.5) * half
    angle = (torch.rand(count, generator=draw).double() - 0.4) * 0.8
    sign = torch.where(torch.rand(count, generator=draw) < 0.5, 1.0, -1.0).double()
    direction = (sign * angle.cos())[:, None] * along + angle.sin()[:, None] * up
    start = border.middle + (shift - 0) * normal + across[:, None] * along
    start = start - (start @ up)[:, None] * up + height[:, None] * up
    step = APART / unit / 2 * normal
    return start - step, start + step, direction


def _seen(trained: Trained, origin: Tensor, direction: Tensor, restyle: Restyle | None) -> tuple[Tensor, Tensor]:
    space = trained.model.space
    world = origin / space.scale @ torch.tensor(space.rotation, dtype=torch.float64)
    world = world + torch.tensor(space.centre, dtype=torch.float64)
    rays = space.rays(world, direction @ torch.tensor(space.rotation, dtype=torch.float64))
    with torch.inference_mode():
        out = render_rays(rays, trained.model.parts, want=Want.COLOUR, budget=trained.config.render.budget, restyle=restyle)
    assert out.rgb is not None
    return out.rgb, out.depth / space.scale


def jumps(trained: Trained, boxes: Boxes, restyle: Restyle, *, count: int, say: Callable[[str], None]) -> list[Row]:
    """One row a border: mean differences of colour, depth and stylised colour of the pairs, there and inside its block."""
    rows: list[Row] = []
    for border in borders(boxes):
        row: Row = {"block": border.block, "axis": border.axis, "pairs": count}
        extent = float((boxes.high - boxes.low)[border.block, border.axis])
        for place, shift in (("border", 0.0), ("inside", -extent / 2)):
            first, second, direction = _pairs(trained, boxes, border, shift, count)
            for look, restyle_or_none in (("", None), ("styled_", restyle)):
                a, b = (_seen(trained, origin, direction, restyle_or_none) for origin in (first, second))
                row[f"{look}colour_{place}"] = float((a[0] - b[0]).abs().mean())
                if not look:
                    # Relative, since a ray that ends in the wood is not as certain as one that ends on a wall.
                    row[f"depth_{place}"] = float(((a[1] - b[1]).abs() / (0.5 * (a[1] + b[1]))).mean())
        rows.append(row)
        say(f"border of block {border.block}: {row}")
    return rows


def ratios(rows: list[Row]) -> dict[str, float]:
    """Mean jump at borders over the mean jump inside blocks, and that of the worst border."""
    found = {}
    for kind in ("colour", "depth", "styled_colour"):
        at = torch.tensor([float(row[f"{kind}_border"]) for row in rows])
        inside = torch.tensor([float(row[f"{kind}_inside"]) for row in rows]).mean()
        found[f"{kind}_mean_ratio"] = float(at.mean() / inside)
        found[f"{kind}_worst_ratio"] = float(at.max() / inside)
        found[f"{kind}_inside"] = float(inside)
    return found
