"""Layouts: where a scene is cut. Geometry alone, in the frame of a `Site`; both fields (`partition`) and Gaussians
(`windows`) are cut by them.

Sparse points reach as far as the eye does; most of a scene's detail lies where its cameras are. So the region
that a grid and halves by density cut is the cameras' bounds widened by REACH_UNITS, but no wider than the points
there are. A region weighs half by the pixels of the cameras that stand in it and half by its share of the sparse
points: cameras say where pixels come from, points where they end.

`bisect` covers all of space: its outer parts have no end, and each holds as many sightings of points.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, TypeVar

import numpy as np
import torch
from torch import Tensor

from ..errors import ConfigError
from ..interfaces import BlockLayout
from ..types import Cell, Site
from .config import AdaptiveConfig, BisectConfig, GridConfig

REACH_UNITS = 1.0
"""Units beyond the cameras that still belong to the region: the distance that views commonly see."""
OUTLIER_SHARE = 0.01
"""Share of the points on either side that is left out: reconstructions have strays."""
MIN_POINTS = 16
"""Fewer points than these say nothing about bounds; by eye."""
PADDING_SHARE = 0.05
"""Bounds found from points are this much wider (share of their size): surfaces must not lie on the border."""
MIN_SIGHTINGS = 8
"""Sightings of points in a part, at least, for each view that learns from it and for each part; by eye."""
_QUANTILE_ROWS = 1 << 24
"""Rows that `Tensor.quantile` takes, at most."""

Half = TypeVar("Half")
Box = tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]
"""Lowest and highest corner."""


def bisect(
    box: Box, state: Half, place: Callable[[Box, Half], tuple[int, float, Half, Half] | None]
) -> list[Box]:
    """Halve a box again and again, in the order of the tree.

    `place` says across which axis a box is cut, where, and the states of both halves; None where it stays
    whole.
    """
    cut = place(box, state)
    if cut is None:
        return [box]
    axis, at, first, second = cut
    low, high = box
    middle_high = high.clone()
    middle_low = low.clone()
    middle_high[axis] = middle_low[axis] = at
    return bisect((low, middle_high), first, place) + bisect((middle_low, high), second, place)


def bounds(site: Site) -> Box:
    """Region that is cut into blocks: around the cameras, shrunk to the points there as far as all cameras
    stay inside.
    """
    low = site.position.amin(0) - REACH_UNITS
    high = site.position.amax(0) + REACH_UNITS
    inside = site.points[((site.points >= low) & (site.points <= high)).all(1)]
    if len(inside) < MIN_POINTS:
        return low, high
    inside = inside[:: -(-len(inside) // _QUANTILE_ROWS)]
    ends = inside.quantile(torch.tensor([OUTLIER_SHARE, 1 - OUTLIER_SHARE], dtype=inside.dtype), 0)
    room = PADDING_SHARE * (ends[1] - ends[0]) + 1e-6
    least = site.position.amin(0)
    most = site.position.amax(0)
    return torch.maximum(low, torch.minimum(ends[0], least) - room), torch.minimum(
        high, torch.maximum(ends[1], most) + room
    )


def _cells(boxes: Sequence[Box], margin: float) -> list[Cell]:
    """The boxes, all with one border."""
    border = torch.full((3,), margin, dtype=torch.float64)
    found: list[Cell] = []
    for low, high in boxes:
        found.append(Cell(low=low, high=high, border=border))
    return found


class GridLayout(BlockLayout):
    """Cells along axes 0 and 1, as high as the region."""

    def __init__(self, config: GridConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> list[Cell]:
        """The cells that hold something, row after row."""
        low, high = bounds(site)
        counts = list(self.config.cells)
        if self.config.size is not None:
            counts = []
            for a in range(2):
                counts.append(max(1, round(float(high[a] - low[a]) * site.unit / self.config.size)))
        margin = self.config.margin * min(float(high[a] - low[a]) / n for a, n in enumerate(counts))
        # what is found on the region's border lies inside its blocks
        low = low - margin
        high = high + margin
        sides = []
        for a, n in enumerate(counts):
            sides.append(torch.linspace(float(low[a]), float(high[a]), n + 1, dtype=low.dtype))
        lows = torch.cartesian_prod(sides[0][:-1], sides[1][:-1], low[2:])
        highs = torch.cartesian_prod(sides[0][1:], sides[1][1:], high[2:])
        # Cells that no camera stands in, and where next to nothing was found, are surroundings.
        boxes = []
        for first, last in zip(lows, highs, strict=True):
            cameras = ((site.position >= first) & (site.position <= last))[:, :2].all(1)
            points = ((site.points >= first) & (site.points <= last)).all(1)
            if bool(cameras.any()) or int(points.sum()) >= MIN_POINTS or not len(site.points):
                boxes.append((first, last))
        return _cells(boxes, margin)


class AdaptiveLayout(BlockLayout):
    """Splits along the longer horizontal side, where the weight halves."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> list[Cell]:
        """The leaves that weigh anything, in the order of the tree."""
        low, high = bounds(site)
        if self.config.smallest is None:
            smallest = 0.1 * float((high - low)[:2].amax())
        else:
            smallest = self.config.smallest / site.unit
        # Places seen from above, and the training pixels that each stands for.
        points = site.points[((site.points >= low) & (site.points <= high)).all(1)]
        rays = site.rays.double()
        share = 0.5 if len(points) else 1.0
        each = points.new_full((len(points),), 0.5 * float(rays.sum()) / max(1, len(points)))
        place = torch.cat([site.position[:, :2], points[:, :2]])
        weight = torch.cat([share * rays, each])

        def inside(box: Box) -> Annotated[Tensor, "N"]:
            return ((place >= box[0][:2]) & (place < box[1][:2])).all(1)

        def halved(box: Box, _: None) -> tuple[int, float, None, None] | None:
            extent = (box[1] - box[0])[:2]
            axis = int(extent.argmax())
            here = inside(box)
            load = float(weight[here].sum())
            if load <= self.config.rays or float(extent[axis]) < 2 * smallest:
                return None
            # The weighted median, moved so that neither half is too small.
            values = place[here, axis]
            order = values.argsort()
            total = weight[here][order].cumsum(0)
            at = float(values[order[int(torch.searchsorted(total, total[-1] / 2))]])
            return (
                axis,
                min(max(at, float(box[0][axis]) + smallest), float(box[1][axis]) - smallest),
                None,
                None,
            )

        leaves = []
        for box in bisect((low, high), None, halved):
            if float(weight[inside(box)].sum()) > 0:
                leaves.append(box)
        if not leaves:
            leaves = [(low, high)]
        # The border is that of the smallest side that may be: another budget moves no block that it does not
        # split.
        if len(leaves) > 1:
            margin = self.config.margin * smallest
        else:
            margin = 0.0
        # What is found on the region's border lies inside its blocks.
        boxes = []
        for first, last in leaves:
            outer_low = torch.where(first <= low, first - margin, first)
            outer_high = torch.where(last >= high, last + margin, last)
            boxes.append((outer_low, outer_high))
        return _cells(boxes, margin)


class BisectLayout(BlockLayout):
    """Halves that were seen equally often, again and again, across the axis along which most lies."""

    def __init__(self, config: BisectConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> list[Cell]:
        """As many cells as the config says, in the order of the tree; outer ones have no end.

        Without points the cameras count in their place: fewer cells where they are few. Raises ConfigError where
        points are too few.
        """
        count = self.config.count
        places = site.position if site.seen is None else site.seen
        if site.seen is None:
            count = max(1, min(count, len(places) // MIN_SIGHTINGS))
        elif len(places) < MIN_SIGHTINGS * count:
            raise ConfigError(
                f"has too few points of a reconstruction for {count} cells; train it in one piece"
            )

        def halved(box: Box, count: int) -> tuple[int, float, int, int] | None:
            inside = places[((places >= box[0]) & (places < box[1])).all(1)]
            if count == 1 or len(inside) < 2:
                return None
            first, last = extent(inside)
            axis = int((last - first).argmax())
            half = count // 2
            return axis, float(np.quantile(inside[:, axis].numpy(), half / count)), half, count - half

        endless = torch.full((3,), math.inf, dtype=torch.float64)
        boxes = bisect((-endless, endless), count, halved)
        # One border for all: a share of the shortest side of what is seen in any of them.
        shortest = math.inf
        for low, high in boxes:
            inside = places[((places >= low) & (places < high)).all(1)]
            if len(inside):
                first, last = extent(inside)
                shortest = min(shortest, float((last - first)[:2].amin()))
        if not 0 < shortest < math.inf:  # all in one place: any border will do
            shortest = 1.0
        return _cells(boxes, self.config.margin * shortest)


def extent(values: Annotated[Tensor, "N K"]) -> tuple[Annotated[Tensor, "K"], Annotated[Tensor, "K"]]:
    """Quantiles between which nearly all rows lie."""
    low, high = np.quantile(values.numpy(), (OUTLIER_SHARE, 1 - OUTLIER_SHARE), axis=0)
    return torch.from_numpy(low), torch.from_numpy(high)
