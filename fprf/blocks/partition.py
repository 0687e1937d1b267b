"""A partition of a scene: boxes that are trained apart, of fields (blocks) and of Gaussians (cells), and their file.

Blocks lie in the scene's space and cut it seen from above; what none of them holds is surroundings. Sparse points reach as
far as the eye does; most of a scene's detail lies where its cameras are. So the region that is cut is the cameras' bounds
widened by REACH, but no wider than the points there are. A region weighs half by the pixels of the cameras that stand in it
and half by its share of the sparse points: cameras say where pixels come from, points where they end.

Cells of Gaussians cover all of space: it is bisected along the principal axes of the reconstruction's points, so that the
points of each cell were seen about equally often, and outer cells have no end. A cell learns from the windows of photographs
that show its points and a border around it, so its cost follows from its windows alone (compare VastGaussian, Lin et al.
2024).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import torch
from torch import Tensor

from ..datamanagers.scene import Scene, find_sightings
from ..errors import ConfigError
from ..interfaces import BlockLayout
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..plugins.codec import from_json
from ..types import Cell, Site, Window
from .config import AdaptiveConfig, GridConfig

REACH = 1.0
"""Units beyond the cameras that still belong to the region; a unit is the distance that views commonly see."""
OUTLIERS = 0.01
"""Share of the points on either side that is left out: reconstructions have strays."""
FEW = 16
"""Fewer points than these say nothing about bounds."""
PADDING = 0.05
"""Bounds found from points are this much wider (share of their size): surfaces must not lie on the border."""
BORDER = 0.05
"""Border of a cell of Gaussians as a share of its width."""
SEEN = 8
"""Points of a cell that a view shows, at least, where the cell learns from it."""
OWN = 0.15
"""Share of the points in a window that are the cell's own, at least."""
LEAST, ROOM = 64, 6
"""Least width and height of a window; pixels around the points in it."""

State = TypeVar("State")
Box = tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]
"""Lowest and highest corner."""


def bisect(box: Box, state: State, place: Callable[[Box, State], tuple[int, float, State, State] | None]) -> list[Box]:
    """Halve a box again and again, in the order of the tree.

    `place` says across which axis a box is cut, where, and the states of both halves; None where it stays whole.
    """
    cut = place(box, state)
    if cut is None:
        return [box]
    axis, at, first, second = cut
    low, high = box
    middle_high, middle_low = high.clone(), low.clone()
    middle_high[axis] = middle_low[axis] = at
    return bisect((low, middle_high), first, place) + bisect((middle_low, high), second, place)


def bounds(site: Site) -> Box:
    """Region that is cut into blocks: around the cameras, shrunk to the points there as far as all cameras stay inside."""
    low, high = site.position.amin(0) - REACH, site.position.amax(0) + REACH
    inside = site.points[((site.points >= low) & (site.points <= high)).all(1)]
    if len(inside) < FEW:
        return low, high
    ends = inside.quantile(torch.tensor([OUTLIERS, 1 - OUTLIERS], dtype=inside.dtype), 0)
    room = PADDING * (ends[1] - ends[0]) + 1e-6
    least, most = site.position.amin(0), site.position.amax(0)
    return torch.maximum(low, torch.minimum(ends[0], least) - room), torch.minimum(high, torch.maximum(ends[1], most) + room)


def _blocks(boxes: Sequence[Box], margin: float) -> list[Cell]:
    border = torch.full((3,), margin, dtype=torch.float64)
    return [Cell(low=low, high=high, border=border) for low, high in boxes]


class GridLayout(BlockLayout):
    """Cells along axes 0 and 1, as high as the region."""

    def __init__(self, config: GridConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> list[Cell]:
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
        # Cells that no camera stands in, and where next to nothing was found, are surroundings.
        boxes = []
        for first, last in zip(lows, highs, strict=True):
            cameras = ((site.position >= first) & (site.position <= last))[:, :2].all(1)
            points = ((site.points >= first) & (site.points <= last)).all(1)
            if bool(cameras.any()) or int(points.sum()) >= FEW or not len(site.points):
                boxes.append((first, last))
        return _blocks(boxes, margin)


class AdaptiveLayout(BlockLayout):
    """Splits along the longer horizontal side, where the weight halves."""

    def __init__(self, config: AdaptiveConfig) -> None:
        self.config = config

    def cut(self, site: Site) -> list[Cell]:
        """The leaves that weigh anything, in the order of the tree."""
        low, high = bounds(site)
        smallest = 0.1 * float((high - low)[:2].amax()) if self.config.smallest is None else self.config.smallest / site.unit
        # Places seen from above, and the training pixels that each stands for.
        points = site.points[((site.points >= low) & (site.points <= high)).all(1)]
        rays, share = site.rays.double(), 0.5 if len(points) else 1.0
        each = points.new_full((len(points),), 0.5 * float(rays.sum()) / max(1, len(points)))
        place, weight = torch.cat([site.position[:, :2], points[:, :2]]), torch.cat([share * rays, each])

        def inside(box: Box) -> Annotated[Tensor, "N"]:
            return ((place >= box[0][:2]) & (place < box[1][:2])).all(1)

        def halved(box: Box, _: None) -> tuple[int, float, None, None] | None:
            extent = (box[1] - box[0])[:2]
            axis, here = int(extent.argmax()), inside(box)
            load = float(weight[here].sum())
            if load <= self.config.rays or float(extent[axis]) < 2 * smallest:
                return None
            # The weighted median, moved so that neither half is too small.
            values = place[here, axis]
            order = values.argsort()
            total = weight[here][order].cumsum(0)
            at = float(values[order[int(torch.searchsorted(total, total[-1] / 2))]])
            return axis, min(max(at, float(box[0][axis]) + smallest), float(box[1][axis]) - smallest), None, None

        leaves = [box for box in bisect((low, high), None, halved) if float(weight[inside(box)].sum()) > 0] or [(low, high)]
        # The border is that of the smallest side that may be: another budget moves no block that it does not split.
        margin = self.config.margin * smallest if len(leaves) > 1 else 0.0
        # What is found on the region's border lies inside its blocks.
        return _blocks(
            [
                (torch.where(first <= low, first - margin, first), torch.where(last >= high, last + margin, last))
                for first, last in leaves
            ],
            margin,
        )


def bisect_sightings(scene: Scene, count: int) -> list[Cell]:
    """`count` cells, each with about as many sightings of points. Raises ConfigError where the points do not allow that."""
    sightings = find_sightings(scene)
    if sightings is None or len(sightings.view) < SEEN * count:
        raise ConfigError(
            f"cells: {scene.name} has too few points of a reconstruction for {count} cells; train it in one piece"
        )
    # Sightings [O] come view by view; `ends` says where each view begins. `local` are their points along principal axes.
    ends = torch.searchsorted(sightings.view, torch.arange(len(scene.cameras) + 1))
    centred = sightings.point - sightings.point.mean(0)
    frame = torch.linalg.eigh(centred.T @ centred).eigenvectors.T.flip(0).contiguous()
    local = sightings.point @ frame.T

    def halved(box: Box, count: int) -> tuple[int, float, int, int] | None:
        if count == 1:
            return None
        inside = local[((local >= box[0]) & (local < box[1])).all(1)]
        first, last = _extent(inside)
        axis = int((last - first).argmax())
        half = count // 2
        return axis, float(np.quantile(inside[:, axis].numpy(), half / count)), half, count - half

    endless = torch.full((3,), math.inf, dtype=torch.float64)
    cells = []
    for low, high in bisect((-endless, endless), count, halved):
        # The cell learns what lies within a border around it as well, so that nothing is missing at its faces.
        inside = ((local >= low) & (local < high)).all(1)
        first, last = _extent(local[inside])
        border = BORDER * (last - first)
        near = ((local >= low - border) & (local < high + border)).all(1)
        # A view's window is around the points in the cell and its border, where enough of what it shows is the cell's own.
        windows: dict[int, Window] = {}
        for view in torch.unique(sightings.view[near]).tolist():
            of_view = slice(int(ends[view]), int(ends[view + 1]))
            pixel = sightings.pixel[of_view][near[of_view]]
            if len(pixel) < SEEN:
                continue
            width, height = scene.cameras.size[view].tolist()
            first, last = _extent(pixel)
            left, wide = _interval(float(first[0]), float(last[0]), width)
            top, tall = _interval(float(first[1]), float(last[1]), height)
            x, y = sightings.pixel[of_view].unbind(1)
            shown = (x >= left) & (x < left + wide) & (y >= top) & (y < top + tall)
            if int((inside[of_view] & shown).sum()) >= OWN * int(shown.sum()):
                windows[view] = (left, top, wide, tall)
        if not windows:
            raise ConfigError(f"cells: no view shows {SEEN} points of one of {count} cells; take fewer")
        cells.append(Cell(low=low, high=high, border=border, frame=frame, windows=windows))
    # The outermost windows of each photograph reach its edges: few points lie there, but it shows.
    widened: list[dict[int, Window]] = [{} for _ in cells]
    for view in sorted({view for cell in cells for view in cell.windows}):
        own = [k for k, cell in enumerate(cells) if view in cell.windows]
        window = np.array([cells[k].windows[view] for k in own])
        lows, highs = window[:, :2], window[:, :2] + window[:, 2:]
        lows = np.where(lows == lows.min(0), 0, lows)
        highs = np.where(highs == highs.max(0), scene.cameras.size[view].numpy(), highs)
        for k, (left, top), (wide, tall) in zip(own, lows.tolist(), (highs - lows).tolist(), strict=True):
            widened[k][view] = (left, top, wide, tall)
    return [replace(cell, windows=windows) for cell, windows in zip(cells, widened, strict=True)]


def _extent(values: Annotated[Tensor, "N K"]) -> tuple[Annotated[Tensor, "K"], Annotated[Tensor, "K"]]:
    """Quantiles between which nearly all rows lie."""
    low, high = np.quantile(values.numpy(), (OUTLIERS, 1 - OUTLIERS), axis=0)
    return torch.from_numpy(low), torch.from_numpy(high)


def _interval(first: float, last: float, size: int) -> tuple[int, int]:
    """Start and length of a part of [0, size) around [first, last], at least LEAST long where there is room."""
    start = max(0, math.floor(first) - ROOM)
    length = min(max(math.ceil(last) + ROOM - start, LEAST), size)
    return min(start, size - length), length


_FORMAT = 6
_Windows = tuple[tuple[int, int, int, int, int], ...]
"""View, left, top, width, height of each."""


def write_cells(file: Path, cells: Sequence[Cell]) -> bool:
    """Write a partition; True where the file holds another one. Raises CheckpointError where that cannot be read."""
    document = {
        "format": _FORMAT,
        "frame": cells[0].frame.tolist(),
        "cells": [
            {
                # JSON knows no infinity.
                "low": [x if math.isfinite(x) else None for x in cell.low.tolist()],
                "high": [x if math.isfinite(x) else None for x in cell.high.tolist()],
                "border": cell.border.tolist(),
                "windows": [[view, *window] for view, window in cell.windows.items()],
            }
            for cell in cells
        ],
    }
    other = False
    if file.is_file():
        with open_json(file, "remove it and train again") as before:
            other = bool(before != document)
    write_json(file, document)
    return other


def read_cells(file: Path) -> list[Cell]:
    """Read a partition. Raises CheckpointError."""
    with open_json(file, "train the scene again with --output ANOTHER") as document:
        if document["format"] != _FORMAT:
            raise ValueError(f"format {document['format']!r}, this fprf reads {_FORMAT}")
        frame = torch.tensor(document["frame"], dtype=torch.float64).reshape(3, 3)
        return [
            Cell(
                low=_corner(each["low"], -math.inf),
                high=_corner(each["high"], math.inf),
                border=_corner(each["border"], 0.0),
                frame=frame,
                windows={v: (x, y, w, h) for v, x, y, w, h in from_json(each["windows"], _Windows, path="windows")},
            )
            for each in document["cells"]
        ]


def _corner(values: object, infinite: float) -> Annotated[Tensor, "3"]:
    numbers = from_json(values, tuple[float | None, float | None, float | None], path="cells")
    return torch.tensor([infinite if value is None else value for value in numbers], dtype=torch.float64)
