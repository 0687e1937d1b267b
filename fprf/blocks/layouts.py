"""Block layouts: one block, equal cells, a k-d tree over the footprint, segments along the cameras' path.

Sparse points reach as far as the eye does; most of a scene's detail lies where its cameras are. So the region is the cameras'
bounds widened by REACH, but no wider than the points there are.

Halving looks at places only, so a street that was driven there and back is cut once, and a bend turns the segments with it.
A segment reaches to the planes that cut it off, is as wide and high as what was found there, and at the ends of the path
goes on for the distance that views commonly see.

A region weighs half by the pixels of the cameras that stand in it and half by its share of the sparse points: cameras say
where pixels come from, points where they end.
"""

import math
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..fields.layouts import AdaptiveConfig, GridConfig, StreetConfig
from ..interfaces import BlockLayout
from ..types import Boxes, Site

REACH = 1.0
"""Units beyond the cameras that still belong to the region; a unit is the distance that views commonly see."""
OUTLIERS = 0.01
"""Share of the points on either side that is left out: reconstructions have strays."""
FEW = 16
"""Fewer points than these say nothing about bounds."""
PADDING = 0.05
"""Bounds found from points are this much wider (share of their size): surfaces must not lie on the border."""


def bounds(site: Site) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
    """Lowest and highest corner of the region."""
    low, high = site.position.amin(0) - REACH, site.position.amax(0) + REACH
    return within(site, low, high)


def within(
    site: Site, low: Annotated[Tensor, "3"], high: Annotated[Tensor, "3"], points: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The box shrunk to the points inside it, as far as all cameras inside stay there with some room."""
    points = site.points if points is None else points
    inside = points[((points >= low) & (points <= high)).all(1)]
    if len(inside) < FEW:
        return low, high
    ends = inside.quantile(torch.tensor([OUTLIERS, 1 - OUTLIERS], dtype=inside.dtype), 0)
    room = PADDING * (ends[1] - ends[0]) + 1e-6
    here = site.position[((site.position >= low) & (site.position <= high)).all(1)]
    least = here.amin(0) if len(here) else ends[0]
    most = here.amax(0) if len(here) else ends[1]
    return torch.maximum(low, torch.minimum(ends[0], least) - room), torch.minimum(high, torch.maximum(ends[1], most) + room)


def _unturned(low: Annotated[Tensor, "Z 3"], high: Annotated[Tensor, "Z 3"], margin: float) -> Boxes:
    return Boxes(low, high, torch.eye(3, dtype=low.dtype).expand(len(low), 3, 3).clone(), margin)


class SingleLayout(BlockLayout):
    """The default."""

    def cut(self, site: Site) -> Boxes:
        low, high = bounds(site)
        return _unturned(low[None], high[None], 0.0)


class GridLayout(BlockLayout):
    """Cells along axes 0 and 1, as high as the region."""

    def __init__(self, config: GridConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> Boxes:
        """The cells that hold something, row after row."""
        low, high = bounds(site)
        counts = list(self.config.cells)
        if self.config.size is not None:
            counts = [max(1, round(float(high[a] - low[a]) * site.unit / self.config.size)) for a in range(2)]
        margin = self.config.margin * min(float(high[a] - low[a]) / n for a, n in enumerate(counts))
        low, high = low - margin, high + margin  # what is found on the region's border lies inside its blocks
        sides = [torch.linspace(float(low[a]), float(high[a]), n + 1, dtype=low.dtype) for a, n in enumerate(counts)]
        lows = torch.cartesian_prod(sides[0][:-1], sides[1][:-1], low[2:])
        highs = torch.cartesian_prod(sides[0][1:], sides[1][1:], high[2:])
        kept = torch.tensor([_holds(site, *cell) for cell in zip(lows, highs, strict=True)])
        return _unturned(lows[kept], highs[kept], margin)


def _holds(site: Site, low: torch.Tensor, high: torch.Tensor) -> bool:
    cameras = ((site.position >= low) & (site.position <= high))[:, :2].all(1)
    points = ((site.points >= low) & (site.points <= high)).all(1)
    return bool(cameras.any()) or int(points.sum()) >= FEW or not len(site.points)


_TENTH = 0.1


class _Node(NamedTuple):
    low: Annotated[Tensor, "3"]
    high: Annotated[Tensor, "3"]


class AdaptiveLayout(BlockLayout):
    """Splits along the longer horizontal side, where the weight halves."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> Boxes:
        """The leaves that weigh anything, in the order of the tree."""
        low, high = bounds(site)
        place, weight = _weights(site, low, high)
        extent = high - low
        smallest = _TENTH * float(extent[:2].amax()) if self.config.smallest is None else self.config.smallest / site.unit
        leaves = [n for n in self._split(_Node(low, high), place, weight, smallest) if _load(n, place, weight) > 0]
        leaves = leaves or [_Node(low, high)]
        lows, highs = torch.stack([n.low for n in leaves]), torch.stack([n.high for n in leaves])
        # The margin is that of the smallest side that may be: another budget moves no block that it does not split.
        margin = self.config.margin * smallest if len(leaves) > 1 else 0.0
        # What is found on the region's border lies inside its blocks.
        lows, highs = torch.where(lows <= low, lows - margin, lows), torch.where(highs >= high, highs + margin, highs)
        return _unturned(lows, highs, margin)

    def _split(self, node: _Node, place: Tensor, weight: Tensor, smallest: float) -> list[_Node]:
        axis = int((node.high - node.low)[:2].argmax())
        room = float(node.high[axis] - node.low[axis])
        if _load(node, place, weight) <= self.config.rays or room < 2 * smallest:
            return [node]
        inside = _inside(node, place)
        at = _median(place[inside, axis], weight[inside])
        at = min(max(at, float(node.low[axis]) + smallest), float(node.high[axis]) - smallest)
        first, second = node.high.clone(), node.low.clone()
        first[axis] = second[axis] = at
        halves = _Node(node.low, first), _Node(second, node.high)
        return [leaf for half in halves for leaf in self._split(half, place, weight, smallest)]


def _weights(site: Site, low: Tensor, high: Tensor) -> tuple[Annotated[Tensor, "N 2"], Annotated[Tensor, "N"]]:
    """Places seen from above, and the training pixels that each stands for."""
    points = site.points[((site.points >= low) & (site.points <= high)).all(1)]
    share = 0.5 if len(points) else 1.0
    rays = site.rays.double()
    place = torch.cat([site.position[:, :2], points[:, :2]])
    return place, torch.cat([share * rays, points.new_full((len(points),), 0.5 * float(rays.sum()) / max(1, len(points)))])


def _inside(node: _Node, place: Tensor) -> Annotated[Tensor, "N"]:
    return ((place >= node.low[:2]) & (place < node.high[:2])).all(1)


def _load(node: _Node, place: Tensor, weight: Tensor) -> float:
    return float(weight[_inside(node, place)].sum())


def _median(values: Annotated[Tensor, "N"], weight: Annotated[Tensor, "N"]) -> float:
    """Weighted median."""
    order = values.argsort()
    total = weight[order].cumsum(0)
    at = int(torch.searchsorted(total, total[-1] / 2))
    return float(values[order[at]])


class _Plane(NamedTuple):
    """A cut: the segment lies where (x - point) . normal <= 0."""

    point: Annotated[Tensor, "3"]
    normal: Annotated[Tensor, "3"]


class _Stretch(NamedTuple):
    """Cameras of a part of the path, and what cuts it off."""

    cameras: Annotated[Tensor, "M"]
    planes: tuple[_Plane, ...]


class StreetLayout(BlockLayout):
    """Turned boxes in a row."""

    def __init__(self, config: StreetConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> Boxes:
        stretches = self._stretches(site)
        boxes = [_box(site, stretch) for stretch in stretches]
        low, high, turn, free = (torch.stack(parts) for parts in zip(*boxes, strict=True))
        margin = self.config.margin * float((high - low)[:, 0].amin()) if len(boxes) > 1 else 0.0
        # What is found beside the street, or at its ends, lies inside its block.
        return Boxes(low - margin * free[:, 0], high + margin * free[:, 1], turn, margin)

    def _stretches(self, site: Site) -> list[_Stretch]:
        whole = _Stretch(torch.arange(len(site.position)), ())
        if self.config.length is None:
            return _parts(site, whole, self.config.segments)
        return _short(site, whole, self.config.length / site.unit)


def _parts(site: Site, stretch: _Stretch, count: int) -> list[_Stretch]:
    """So many parts of equal length; fewer, where cameras are."""
    count = min(count, len(stretch.cameras))
    if count < 2 or _extent(site, stretch) <= 0:
        return [stretch]
    first, second = _halve(site, stretch, (count // 2) / count)
    return _parts(site, first, count // 2) + _parts(site, second, count - count // 2)


def _short(site: Site, stretch: _Stretch, longest: float) -> list[_Stretch]:
    """Parts of equal length none of which is longer; a bend shows as it is halved, and is then measured anew."""
    count = math.ceil(_extent(site, stretch) / longest)
    if min(count, len(stretch.cameras)) < 2:
        return [stretch]
    return [part for half in _halve(site, stretch, (count // 2) / count) for part in _short(site, half, longest)]


def _axis(position: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "3"]:
    """The level direction along which cameras spread most, onwards along axis 0 (else along axis 1)."""
    flat = position[:, :2] - position[:, :2].mean(0)
    along = torch.linalg.svd(flat, full_matrices=False).Vh[0] if len(flat) > 1 else flat.new_tensor([1.0, 0.0])
    if along[0] < -1e-9 or (abs(float(along[0])) <= 1e-9 and along[1] < 0):
        along = -along
    return torch.cat([along, along.new_zeros(1)])


def _extent(site: Site, stretch: _Stretch) -> float:
    here = site.position[stretch.cameras]
    along = here @ _axis(here)
    return float(along.amax() - along.amin())


def _halve(site: Site, stretch: _Stretch, share: float) -> list[_Stretch]:
    """Two parts of a stretch, cut across it at a share of its length."""
    here = site.position[stretch.cameras]
    axis = _axis(here)
    along = here @ axis
    at = along.amin() + share * (along.amax() - along.amin())
    middle = here.mean(0)
    point = middle + (at - middle @ axis) * axis
    first = along <= at
    return [
        _Stretch(stretch.cameras[first], (*stretch.planes, _Plane(point, axis))),
        _Stretch(stretch.cameras[~first], (*stretch.planes, _Plane(point, -axis))),
    ]


def _box(site: Site, stretch: _Stretch) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Low, high and turn of a segment, and [2 3] which of its low and high faces no other segment shares."""
    here = site.position[stretch.cameras]
    axis = _axis(here)
    up = axis.new_tensor([0.0, 0.0, 1.0])
    turn = torch.stack([axis, torch.linalg.cross(up, axis), up])
    local = here @ turn.T
    low, high, free = local.amin(0) - REACH, local.amax(0) + REACH, local.new_ones(2, 3)
    for plane in stretch.planes:
        slope = float(plane.normal @ axis)
        if abs(slope) < 0.5:  # a cut along the segment says nothing about where it ends
            continue
        ends = float((plane.point - here.mean(0)) @ plane.normal) / slope + float(here.mean(0) @ axis)
        # A cut that is not quite across leaves some of the segment's own cameras beyond it.
        if slope > 0:
            high[0], free[1, 0] = min(float(high[0]), max(ends, float(local[:, 0].amax()))), 0.0
        else:
            low[0], free[0, 0] = max(float(low[0]), min(ends, float(local[:, 0].amin()))), 0.0
    turned = Site(site.position @ turn.T, site.rays, site.points @ turn.T, site.unit)
    inner_low, inner_high = within(turned, low, high)
    return torch.where(free[0] > 0, inner_low, low), torch.where(free[1] > 0, inner_high, high), turn, free
