"""Routing of points to their blocks. Points are handed out in groups: all points of a group have the same
members.

`to_single` sends all points to one member. `InsetRouter` is for training a block: inside its reach the block,
outside of it the surroundings. `BlendRouter` is for rendering: weights of `windows`, whose smooth change from
block to block leaves no seam. It looks points up in a table of the ground plan, so its cost does not grow
with the number of blocks, and names only the blocks that the points need: the others are never loaded.

Windows: A block reaches a border b beyond its cell. Along each axis its window rises by a smoothstep from 0
at the end of that reach to 1 two borders inside, so it is 1/2 on the cell's face; neighbours that share a
face have windows S and 1 - S there. Where windows sum to less than 1 the surroundings have the rest; where
cells overlap they sum to more and are scaled. The weights are continuous, and so is whatever is blended by
them.

Charts: A block's chart is affine: its cell with the border fills the cube, so that no node of its planes lies
where it has no say. The chart of the surroundings contracts: all blocks together fill the inner half,
everything else the rest.

All points are those of the scene's space, and so are the axes of cells.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple, TypeAlias

import torch
from torch import Tensor

from ..rendering.space import contract
from ..types import Cell

SLIGHT = 1e-6
"""A member of at most this weight is left out; it changes density and colour by as much."""
TABLE = 512
"""Squares of the table along the longer side of the ground plan."""


def window(points: Annotated[Tensor, "N 3"], cell: Cell) -> Annotated[Tensor, "N"]:
    """Window of a block, in [0, 1]; without a border it is that of the bare cell."""
    low = cell.low.to(points)
    high = cell.high.to(points)
    border = cell.border.to(points)
    if not bool((cell.border > 0).all()):
        return ((points >= low) & (points <= high)).all(-1).to(points)
    # Distances are taken from the face before they are divided: a large scene must not lose them.
    rise = torch.minimum(points - low, high - points) / (2 * border) + 0.5
    rise = rise.clamp(0, 1)
    return (rise * rise * (3 - 2 * rise)).prod(-1)


def shares(points: Annotated[Tensor, "N 3"], cells: Sequence[Cell]) -> Annotated[Tensor, "N Z+1"]:
    """Weight of each block at every point, the surroundings last; rows are at least 0 and sum to 1."""
    if not cells:
        return points.new_ones(len(points), 1)
    parts = []
    for cell in cells:
        parts.append(window(points, cell))
    windows = torch.stack(parts, -1)
    total = windows.sum(-1, keepdim=True)
    return torch.cat([windows / total.clamp_min(1), (1 - total).clamp_min(0)], -1)


@dataclass(frozen=True)
class Chart:
    """Coordinates in which low becomes -1 and high becomes 1 (or, contracted, -1/2 and 1/2)."""

    low: Annotated[Tensor, "3"]
    high: Annotated[Tensor, "3"]
    contracted: bool = False

    def locate(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Points of the space to the cube; a block's chart takes those inside its box alone to points inside
        the cube.
        """
        middle, half, _, _ = self._on(points)
        # The middle is taken off before anything is scaled: float32 keeps what is left of a large coordinate.
        y = (points - middle) / half
        return contract(y) if self.contracted else y

    def inside(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """Mask of the points in the box."""
        _, _, low, high = self._on(points)
        return ((points >= low) & (points <= high)).all(-1)

    def _on(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Middle, half size, low and high with the dtype and device of points, copied once, not in each
        training step.
        """
        key = (points.dtype, points.device)
        if key not in self._copies:
            with torch.inference_mode(False):
                middle = (self.low + self.high) / 2
                half = (self.high - self.low) / 2
                self._copies[key] = (
                    middle.to(points),
                    half.to(points),
                    self.low.to(points),
                    self.high.to(points),
                )
        return self._copies[key]

    @cached_property
    def _copies(self) -> dict[tuple[torch.dtype, torch.device], tuple[Tensor, Tensor, Tensor, Tensor]]:
        return {}


def chart_of(cell: Cell) -> Chart:
    """The chart of a block: its cell and the border around it."""
    return Chart(cell.low - cell.border, cell.high + cell.border)


def surroundings_of(cells: Sequence[Cell]) -> Chart:
    """The chart of what no block holds: contracted around the bounds of all cells."""
    parts = []
    for cell in cells:
        parts.append(cell.low)
    low = torch.stack(parts)
    parts = []
    for cell in cells:
        parts.append(cell.high)
    high = torch.stack(parts)
    return Chart(low.amin(0), high.amax(0), contracted=True)


class Group(NamedTuple):
    """Points that the same members share."""

    members: tuple[int, ...]
    at: Annotated[Tensor, "n"]
    """int64, ascending: which points."""
    weight: Annotated[Tensor, "n m"] | None
    """Weight of each member, rows sum to 1; None = there is one alone."""


Router: TypeAlias = Callable[[Tensor], list[Group]]
"""Points [N 3] of the space to groups; each point is in one of them."""


def to_single(points: Annotated[Tensor, "N 3"]) -> list[Group]:
    """One member over everything."""
    return [Group((0,), torch.arange(len(points), device=points.device), None)]


class InsetRouter:
    """Member 0 inside of a chart's box, member 1 outside.

    On an accelerator both members are evaluated at all points, one of them with weight 0: the host would have
    to wait for the number of points inside.
    """

    def __init__(self, chart: Chart) -> None:
        self.chart = chart

    def __call__(self, points: Annotated[Tensor, "N 3"]) -> list[Group]:
        inside = self.chart.inside(points)
        if points.device.type != "cpu":
            every = torch.arange(len(points), device=points.device)
            return [Group((0, 1), every, torch.stack([inside, ~inside], -1).to(points.dtype))]
        parts = (Group((0,), inside.nonzero()[:, 0], None), Group((1,), (~inside).nonzero()[:, 0], None))
        found: list[Group] = []
        for part in parts:
            if len(part.at):
                found.append(part)
        return found


class BlendRouter:
    """Member z is block z, the last one the surroundings."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        self.cells = cells
        charts = []
        for cell in cells:
            charts.append(chart_of(cell))
        parts = []
        for chart in charts:
            parts.append(chart.low)
        low = torch.stack(parts).amin(0)[:2]
        parts = []
        for chart in charts:
            parts.append(chart.high)
        high = torch.stack(parts).amax(0)[:2]
        self.low = low
        self.step = float((high - low).amax()) / TABLE
        counts = ((high - low) / self.step).ceil().long().clamp_min(1)
        self.columns = int(counts[0])
        self.rows = int(counts[1])
        # The middle of each square; it reaches half a diagonal around there, at any height.
        column = torch.arange(self.columns, dtype=torch.float64) + 0.5
        row = torch.arange(self.rows, dtype=torch.float64) + 0.5
        y, x = torch.meshgrid(low[1] + row * self.step, low[0] + column * self.step, indexing="ij")
        middle = torch.stack([x, y, torch.zeros_like(x)], -1).view(-1, 3)
        room = middle.new_tensor([0.75 * self.step, 0.75 * self.step, torch.inf])
        touched = []
        for chart in charts:
            touched.append(Chart(chart.low - room, chart.high + room).inside(middle))
        # The set of blocks whose reach, seen from above, may touch each square. Rows come sorted; the empty
        # set is first, whether or not a square has it: it is what lies beyond the table.
        sets, number = torch.unique(torch.stack(touched, 1), dim=0, return_inverse=True)
        self.sets = [tuple(each.nonzero()[:, 0].tolist()) for each in sets]
        self.table = number
        if self.sets[0]:
            self.table = number + 1
            self.sets = [(), *self.sets]

    def __call__(self, points: Annotated[Tensor, "N 3"]) -> list[Group]:
        """Groups by the blocks near each point; points that one member has alone come without weights."""
        # Look up each point's square; NaN and far points must not become an index.
        at = (points[:, :2] - self.low.to(points)) / self.step
        inside = ((at >= 0) & (at < at.new_tensor([self.columns, self.rows]))).all(1)
        square = torch.where(inside[:, None], at, torch.zeros_like(at)).long()
        kind = self.table.to(points.device)[square[:, 1] * self.columns + square[:, 0]]
        kind = torch.where(inside, kind, torch.zeros_like(kind))
        # Of each set of blocks that is met only these are weighed, and only those with a say are ever
        # fetched.
        groups = []
        present = torch.bincount(kind, minlength=len(self.sets)).nonzero()[:, 0].tolist()
        for number in present:
            if len(present) > 1:
                index = (kind == number).nonzero()[:, 0]
            else:
                index = torch.arange(len(points), device=points.device)
            named = (*self.sets[number], len(self.cells))
            if len(named) == 1:
                groups.append(Group(named, index, None))
                continue
            weight = shares(points[index], [self.cells[block] for block in self.sets[number]])
            weight = torch.where(weight > SLIGHT, weight, torch.zeros_like(weight))
            most, best = weight.max(-1)
            alone = most >= weight.sum(-1)
            for place, member in enumerate(named):
                mine = index[alone & (best == place)]
                if len(mine):
                    groups.append(Group((member,), mine, None))
            # In borders several have a say: their weights are scaled to 1 once the slight ones are left out.
            shared = (~alone).nonzero()[:, 0]
            if len(shared):
                own = weight[shared]
                used = (own > 0).any(0).nonzero()[:, 0]
                own = own[:, used]
                chosen = tuple(named[place] for place in used.tolist())
                groups.append(Group(chosen, index[shared], own / own.sum(-1, keepdim=True)))
        return groups
