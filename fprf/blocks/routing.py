"""Which blocks a point belongs to. Points are handed out in groups: all points of a group have the same members.

`Everywhere` sends all points to one member. `Inset` is for training a block: inside its reach the block, outside of it the
surroundings. `Blend` is for rendering: weights of `windows`, whose smooth change from block to block leaves no seam. It looks
points up in a table of the ground plan, so its cost does not grow with the number of blocks, and names only the blocks that
the points need: the others are never loaded.
"""

from abc import ABC, abstractmethod
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..types import Boxes
from .charts import Chart, chart_of, surroundings_of
from .windows import window

__all__ = ["SLIGHT", "Blend", "Everywhere", "Group", "Inset", "Router"]

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
        """One group."""
        return [self.whole(points)]

    def whole(self, points: Annotated[Tensor, "N 3"]) -> Group:
        """The group of all points."""
        return Group((0,), _all(points), None)


class Inset(Router):
    """Member 0 inside of a chart's box, member 1 outside.

    On an accelerator both members are evaluated at all points, one of them with weight 0: the host would have to wait for the
    number of points inside.
    """

    def __init__(self, chart: Chart) -> None:
        self.chart = chart

    def __call__(self, points: Annotated[Tensor, "N 3"]) -> list[Group]:
        """Up to two groups."""
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
        whole = surroundings_of(_reaching(boxes))
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
        """Which set of blocks the table names at each point; set 0 is none."""
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
        here = points[index]
        windows = torch.stack([window(here, self.boxes, block) for block in members], -1)
        total = windows.sum(-1, keepdim=True)
        weight = torch.cat([windows / total.clamp_min(1), (1 - total).clamp_min(0)], -1)
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
        middle = torch.stack(
            torch.meshgrid(
                self.low[1] + (torch.arange(self.rows, dtype=torch.float64) + 0.5) * self.step,
                self.low[0] + (torch.arange(self.columns, dtype=torch.float64) + 0.5) * self.step,
                indexing="ij",
            ),
            -1,
        ).reshape(-1, 2)
        middle = torch.cat([middle.flip(1), middle.new_zeros(len(middle), 1)], 1)
        touched = torch.zeros(len(middle), self.around, dtype=torch.bool)
        for block in range(self.around):
            chart = chart_of(self.boxes, block)
            # A cell reaches half its diagonal around its middle; turned boxes are level, so heights don't matter.
            room = chart.low.new_full((3,), 0.75 * self.step)
            room[2] = torch.inf
            touched[:, block] = Chart(chart.low - room, chart.high + room, chart.turn).inside(middle)
        sets, number = torch.unique(touched, dim=0, return_inverse=True)
        names = [tuple(row.nonzero()[:, 0].tolist()) for row in sets]
        # The empty set comes first, whether or not a cell has it: it is what lies beyond the table.
        if () in names:
            first = names.index(())
            order = [first, *(k for k in range(len(names)) if k != first)]
            rank = torch.empty(len(names), dtype=torch.int64)
            rank[torch.tensor(order)] = torch.arange(len(names))
            return rank[number], [names[k] for k in order]
        return number + 1, [(), *names]


def _all(points: Tensor) -> Annotated[Tensor, "N"]:
    return torch.arange(len(points), device=points.device)


def _reaching(boxes: Boxes) -> Boxes:
    """The boxes with their margins."""
    return Boxes(boxes.low - boxes.margin, boxes.high + boxes.margin, boxes.turn, 0.0)
