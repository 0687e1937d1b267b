"""Routing of points to their blocks. Points are handed out in groups: all points of a group have the same members.

`Everywhere` sends all points to one member. `Inset` is for training a block: inside its reach the block, outside of it the
surroundings. `Blend` is for rendering: weights of `windows`, whose smooth change from block to block leaves no seam. It looks
points up in a table of the ground plan, so its cost does not grow with the number of blocks, and names only the blocks that
the points need: the others are never loaded.

Windows: A block reaches a margin m beyond its cell. Along each axis its window rises by a smoothstep from 0 on the border of
that reach to 1 two margins inside, so it is 1/2 on the cell's face; neighbours that share a face have windows S and 1 - S
there. Where windows sum to less than 1 the surroundings have the rest; where cells overlap (bends) they sum to more and are
scaled. The weights are continuous, and so is whatever is blended by them.

Charts: A block's chart is affine: its cell with the margin fills the cube, so that no node of its planes lies where it has no
say. The chart of the surroundings contracts: all blocks together fill the inner half, everything else the rest.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..rendering.space import contract
from ..types import Boxes


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


def shares(points: Annotated[Tensor, "N 3"], boxes: Boxes, blocks: Sequence[int] | None = None) -> Annotated[Tensor, "N Z+1"]:
    """Weight of some blocks, or of every one, at every point, the surroundings last; rows are at least 0 and sum to 1."""
    chosen = range(len(boxes.low)) if blocks is None else blocks
    if not chosen:
        return points.new_ones(len(points), 1)
    windows = torch.stack([window(points, boxes, block) for block in chosen], -1)
    total = windows.sum(-1, keepdim=True)
    return torch.cat([windows / total.clamp_min(1), (1 - total).clamp_min(0)], -1)


@dataclass(frozen=True)
class Chart:
    """Turned axes in which low becomes -1 and high becomes 1 (or, contracted, -1/2 and 1/2)."""

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
        """Mask of the points in the box."""
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


SLIGHT = 1e-6
"""A member of at most this weight is left out; it changes density and colour by as much."""
TABLE = 512
"""Cells of the table along the longer side of the ground plan."""


class Group(NamedTuple):
    """Points that the same members share."""

    members: tuple[int, ...]
    at: Annotated[Tensor, "n"]
    """int64, ascending: which points."""
    weight: Annotated[Tensor, "n m"] | None
    """Weight of each member, rows sum to 1; None = there is one alone."""


class Router(ABC):
    """Points to groups; each point is in one of them."""

    @abstractmethod
    def __call__(self, points: Annotated[Tensor, "N 3"]) -> list[Group]:
        """The groups of points of the space."""

    def whole(self, points: Annotated[Tensor, "N 3"]) -> Group | None:
        """The only group, where all points are in one; None where that depends on the points."""
        return None


class Everywhere(Router):
    """One member over everything."""

    def __call__(self, points: Annotated[Tensor, "N 3"]) -> list[Group]:
        return [self.whole(points)]

    def whole(self, points: Annotated[Tensor, "N 3"]) -> Group:
        return Group((0,), _all(points), None)


class Inset(Router):
    """Member 0 inside of a chart's box, member 1 outside.

    On an accelerator both members are evaluated at all points, one of them with weight 0: the host would have to wait for the
    number of points inside.
    """

    def __init__(self, chart: Chart) -> None:
        self.chart = chart

    def __call__(self, points: Annotated[Tensor, "N 3"]) -> list[Group]:
        whole = self.whole(points)
        if whole is not None:
            return [whole]
        inside = self.chart.inside(points)
        parts = (Group((0,), inside.nonzero()[:, 0], None), Group((1,), (~inside).nonzero()[:, 0], None))
        return [part for part in parts if len(part.at)]

    def whole(self, points: Annotated[Tensor, "N 3"]) -> Group | None:
        """Both members at all points, on an accelerator."""
        if points.device.type == "cpu":
            return None
        inside = self.chart.inside(points)
        return Group((0, 1), _all(points), torch.stack([inside, ~inside], -1).to(points.dtype))


class Blend(Router):
    """Member z is block z, the last one the surroundings."""

    def __init__(self, boxes: Boxes) -> None:
        self.boxes = boxes
        self.around = len(boxes.low)
        whole = surroundings_of(Boxes(boxes.low - boxes.margin, boxes.high + boxes.margin, boxes.turn, 0.0))
        low, high = whole.low[:2], whole.high[:2]
        self.low, self.step = low, float((high - low).amax()) / TABLE
        counts = ((high - low) / self.step).ceil().long().clamp_min(1)
        self.columns, self.rows = int(counts[0]), int(counts[1])
        self.table, self.sets = self._tabulate()

    def __call__(self, points: Annotated[Tensor, "N 3"]) -> list[Group]:
        """Groups by the blocks near each point; points that one member has alone come without weights."""
        kind = self._kinds(points)
        groups = []
        present = torch.bincount(kind, minlength=len(self.sets)).nonzero()[:, 0].tolist()
        for number in present:
            index = (kind == number).nonzero()[:, 0] if len(present) > 1 else torch.arange(len(points), device=points.device)
            groups += self._share(points, index, self.sets[number])
        return groups

    def _kinds(self, points: Tensor) -> Annotated[Tensor, "N"]:
        """Set of blocks that the table names at each point; set 0 is none."""
        at = (points[:, :2] - self.low.to(points)) / self.step
        inside = ((at >= 0) & (at < at.new_tensor([self.columns, self.rows]))).all(1)
        # NaN and far points must not become an index.
        cell = torch.where(inside[:, None], at, torch.zeros_like(at)).long()
        kind = self.table.to(points.device)[cell[:, 1] * self.columns + cell[:, 0]]
        return torch.where(inside, kind, torch.zeros_like(kind))

    def _share(self, points: Tensor, index: Tensor, members: tuple[int, ...]) -> list[Group]:
        """Groups of the points of one set."""
        if not members:
            return [Group((self.around,), index, None)]
        weight = shares(points[index], self.boxes, members)
        weight = torch.where(weight > SLIGHT, weight, torch.zeros_like(weight))
        most, best = weight.max(-1)
        alone = most >= weight.sum(-1)
        groups = []
        named = (*members, self.around)
        for place, member in enumerate(named):
            mine = index[alone & (best == place)]
            if len(mine):
                groups.append(Group((member,), mine, None))
        shared = (~alone).nonzero()[:, 0]
        if len(shared):
            own = weight[shared]
            used = (own > 0).any(0).nonzero()[:, 0]
            own = own[:, used]
            chosen = tuple(named[place] for place in used.tolist())
            groups.append(Group(chosen, index[shared], own / own.sum(-1, keepdim=True)))
        return groups

    def _tabulate(self) -> tuple[Tensor, list[tuple[int, ...]]]:
        """Set of blocks whose reach, seen from above, may touch each cell of the table; sets are numbered as they come."""
        column, row = (torch.arange(count, dtype=torch.float64) + 0.5 for count in (self.columns, self.rows))
        y, x = torch.meshgrid(self.low[1] + row * self.step, self.low[0] + column * self.step, indexing="ij")
        middle = torch.stack([x, y, torch.zeros_like(x)], -1).view(-1, 3)
        # A cell reaches half its diagonal around its middle; turned boxes are level, so heights don't matter.
        room = middle.new_tensor([0.75 * self.step, 0.75 * self.step, torch.inf])
        charts = [chart_of(self.boxes, block) for block in range(self.around)]
        touched = [Chart(chart.low - room, chart.high + room, chart.turn).inside(middle) for chart in charts]
        # Rows come sorted. The empty set is first, whether or not a cell has it: it is what lies beyond the table.
        sets, number = torch.unique(torch.stack(touched, 1), dim=0, return_inverse=True)
        names = [tuple(each.nonzero()[:, 0].tolist()) for each in sets]
        return (number, names) if not names[0] else (number + 1, [(), *names])


def _all(points: Tensor) -> Annotated[Tensor, "N"]:
    return torch.arange(len(points), device=points.device)
