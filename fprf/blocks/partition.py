"""A partition of a scene: boxes that are trained apart, of fields (blocks) and of Gaussians (cells), and
their file.

Blocks lie in the scene's space, the same for all, so that their densities blend as they are, and cut it seen
from above; what none of them holds is surroundings. Sparse points reach as far as the eye does; most of a
scene's detail lies where its cameras are. So the region that is cut is the cameras' bounds widened by REACH,
but no wider than the points there are. A region weighs half by the pixels of the cameras that stand in it and
half by its share of the sparse points: cameras say where pixels come from, points where they end.

Which tiles of which views a block learns from follows from cameras and sparse points alone, before any image
is decoded. A tile's rays reach BEYOND times as far as the farthest point that is seen in it or its
neighbours, and without end where nothing is (the sky).

Cells of Gaussians cover all of space: it is bisected along the principal axes of the reconstruction's points,
so that the points of each cell were seen about equally often, and outer cells have no end. A cell learns from
the windows of photographs that show its points and a border around it, so its cost follows from its windows
alone (compare VastGaussian, Lin et al.
2024).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.bounds import FAR, NEAR, ROUNDING, axes
from ..datamanagers.scene import TILES, ParsedScene, Sightings, find_sightings, tile_of
from ..errors import ConfigError, DataError
from ..interfaces import BlockLayout
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..plugins.codec import from_json
from ..rendering.cameras import Cameras, rays_through
from ..rendering.space import Space, slab
from ..types import Cell, Site, Window
from .config import AdaptiveConfig, GridConfig, LayoutConfig
from .routing import chart_of

REACH = 1.0
"""Units beyond the cameras that still belong to the region; a unit is the distance that views commonly
see.
"""
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
LEAST = 64
ROOM = 6
"""Least width and height of a window; pixels around the points in it."""
FLAT = 0.3
"""Cameras spread over a plane if their third extent is below this share of their second ..."""
WIDE = 0.2
"""... and that one above this share of the first."""
NEAREST = 0.001
"""Share of the sightings that may lie closer than twice the nearest distance that is looked at."""
SPACINGS = 10.0
"""Without points views are taken to see this many times the distance to the next camera ..."""
SOME = 512
"""... which is measured for about so many of them."""
BEYOND = 1.25
"""Rays end at most so many times farther than what is seen around them."""
VIEWS = 256
"""Views whose tiles are looked at together: bounds memory, changes nothing."""
_ROWS = 1 << 24
"""Rows that `Tensor.quantile` takes, at most."""

State = TypeVar("State")
Box = tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]
"""Lowest and highest corner."""


def bisect(
    box: Box, state: State, place: Callable[[Box, State], tuple[int, float, State, State] | None]
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
    low = site.position.amin(0) - REACH
    high = site.position.amax(0) + REACH
    inside = site.points[((site.points >= low) & (site.points <= high)).all(1)]
    if len(inside) < FEW:
        return low, high
    inside = inside[:: -(-len(inside) // _ROWS)]
    ends = inside.quantile(torch.tensor([OUTLIERS, 1 - OUTLIERS], dtype=inside.dtype), 0)
    room = PADDING * (ends[1] - ends[0]) + 1e-6
    least = site.position.amin(0)
    most = site.position.amax(0)
    return torch.maximum(low, torch.minimum(ends[0], least) - room), torch.minimum(
        high, torch.maximum(ends[1], most) + room
    )


def _blocks(boxes: Sequence[Box], margin: float) -> list[Cell]:
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

        leaves = [
            box for box in bisect((low, high), None, halved) if float(weight[inside(box)].sum()) > 0
        ] or [(low, high)]
        # The border is that of the smallest side that may be: another budget moves no block that it does not
        # split.
        if len(leaves) > 1:
            margin = self.config.margin * smallest
        else:
            margin = 0.0
        # What is found on the region's border lies inside its blocks.
        return _blocks(
            [
                (
                    torch.where(first <= low, first - margin, first),
                    torch.where(last >= high, last + margin, last),
                )
                for first, last in leaves
            ],
            margin,
        )


def level_axes(cameras: Cameras) -> Annotated[Tensor, "3 3"]:
    """Rows: along the capture, across, up. Over a plane (drones) its normal is up; along a line (streets) the
    cameras' own.
    """
    offset = cameras.pose[:, :, 3] - cameras.pose[:, :, 3].mean(0)
    _, extent, rows = torch.linalg.svd(offset, full_matrices=True)
    if len(extent) < 3 or extent[2] > FLAT * extent[1] or extent[1] < WIDE * extent[0]:
        return axes(cameras)
    up = rows[2]
    along = rows[0]
    upright = cameras.pose[:, :, 1].mean(0)
    ahead = -cameras.pose[:, :, 2].mean(0)
    # Cameras stand upright, or look down: one of the two tells which side of the plane the sky is on.
    if (upright @ up - ahead @ up) < 0:
        up = -up
    if offset[-1] @ along < offset[0] @ along:
        along = -along
    return torch.stack([along, torch.linalg.cross(up, along), up])


def open_space(scene: ParsedScene, sightings: Sightings | None) -> Space:
    """The space of kind `open`. Raises DataError where all cameras stand in one place and nothing says how
    far they see.
    """
    # A unit is the distance that views commonly see: of points, else as the capture says, else of the
    # cameras' spacing.
    position = scene.cameras.pose[:, :, 3]
    centre = position.mean(0)
    turn = level_axes(scene.cameras)
    nearest = None
    if sightings is not None:
        unit = float(sightings.distance.median())
        nearest = float(sightings.distance.sort().values[int(NEAREST * len(sightings.distance))])
    elif scene.depths is not None:
        unit = float(scene.depths.prod(-1).sqrt().median())
        nearest = float(scene.depths[:, 0].amin())
    else:
        apart = torch.cdist(position[:: max(1, len(position) // SOME)], position)
        if len(position) > 1:
            unit = SPACINGS * float(apart.topk(2, largest=False).values[:, 1].median())
        else:
            unit = 0.0
    if unit <= ROUNDING * max(1.0, float(position.abs().amax())):
        raise DataError(
            f"{scene.name}: all cameras stand in one place and there are no points; capture from several places"
        )
    # Nothing nearer than half of the nearest point is looked at.
    if nearest is None:
        near = NEAR
    else:
        near = min(NEAR, max(1e-3, 0.5 * nearest / unit))
    first, second, third = ((float(row[0]), float(row[1]), float(row[2])) for row in turn)
    middle = (float(centre[0]), float(centre[1]), float(centre[2]))
    return Space("open", middle, (first, second, third), 1 / unit, near, FAR)


def site_of(scene: ParsedScene, space: Space) -> Site:
    """Training cameras and sparse points in the space."""
    turn = torch.tensor(space.rotation, dtype=torch.float64)
    centre = torch.tensor(space.centre, dtype=torch.float64)
    cameras = scene.cameras.select(scene.train)
    if scene.points is not None:
        points = scene.points
    else:
        points = centre.new_zeros(0, 3)
    return Site(
        ((cameras.pose[:, :, 3] - centre) @ turn.T) * space.scale,
        cameras.size.prod(-1),
        ((points - centre) @ turn.T) * space.scale,
        1 / space.scale,
    )


def tile_rays(
    scene: ParsedScene, space: Space, views: Annotated[Tensor, "M"], sightings: Sightings | None
) -> tuple[
    Annotated[Tensor, "M 1 1 3"],
    Annotated[Tensor, "M TILES TILES 3"],
    Annotated[Tensor, "M TILES TILES"],
    Annotated[Tensor, "M TILES TILES"],
]:
    """Origins and directions of the rays through the middles of the tiles [row, column] of some views, in the
    space.

    Then upper bounds of their lengths, space units (inf where nothing is known), and the pixels of each tile
    (int64; 0 outside of the image). Float32 is enough here.
    """
    cameras = scene.cameras
    size = cameras.size[views].double()
    side = size.amax(1) / TILES
    low = side[:, None] * torch.arange(TILES, dtype=torch.float64)
    # Pixel centres (+0.5) in each column and row of tiles, as `tile_of` puts them there.
    ends = []
    for extent in size.T:
        ends.append(torch.minimum(low + side[:, None], extent[:, None]))
    columns, rows = (((end - 0.5).ceil() - (low - 0.5).ceil()).clamp_min(0).long() for end in ends)
    # The ray through the middle of each tile.
    middle = low + side[:, None] / 2
    x, y = (torch.minimum(middle, extent[:, None] - 0.5) for extent in size.T)
    pixel = torch.stack([x[:, None, :].expand(-1, TILES, -1), y[:, :, None].expand(-1, -1, TILES)], -1)
    which = views[:, None, None].expand(-1, TILES, TILES).reshape(-1)
    rays = space.rays(*rays_through(cameras, which, pixel.reshape(-1, 2)))
    # The farthest point that is seen in each tile, then in it or its neighbours; the sky has none.
    reach = torch.full((len(views), TILES, TILES), torch.inf)
    if sightings is not None:
        slot = torch.full((len(cameras),), -1, dtype=torch.int64)
        slot[views] = torch.arange(len(views))
        mine = slot[sightings.view] >= 0
        view = sightings.view[mine]
        pixels = sightings.pixel[mine]
        column, row = tile_of(cameras, view, pixels).unbind(1)
        at = (slot[view] * TILES + row) * TILES + column
        far = torch.zeros(len(views), TILES, TILES)
        far.view(-1).scatter_reduce_(0, at, (sightings.distance[mine] * space.scale).float(), "amax")
        around = F.max_pool2d(far[:, None], 3, stride=1, padding=1)[:, 0]
        reach = torch.where(around > 0, BEYOND * around, reach)
    direction = rays.direction.view(-1, TILES, TILES, 3)
    return (
        rays.origin.view(direction.shape)[:, :1, :1],
        direction,
        reach,
        rows[:, :, None] * columns[:, None, :],
    )


def pixel_mask(seen: Annotated[Tensor, "TILES TILES"], size: tuple[int, int]) -> Annotated[Tensor, "H W"]:
    """The pixels of the tiles that are set, for an image of (width, height)."""
    width, height = size
    side = max(size) / TILES
    column = ((torch.arange(width, dtype=torch.float64) + 0.5) / side).long().clamp(max=TILES - 1)
    row = ((torch.arange(height, dtype=torch.float64) + 0.5) / side).long().clamp(max=TILES - 1)
    return seen[row][:, column]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Z blocks of a scene, T training views."""

    space: Space
    cells: Sequence[Cell]
    views: Annotated[Tensor, "T"]
    """int64 training views of the scene."""
    seen: Annotated[Tensor, "T Z TILES TILES"]
    """Tiles of each view that each block learns from."""
    pixels: Annotated[Tensor, "T TILES TILES"]
    """int64 pixels of each tile."""

    @property
    def rays(self) -> Annotated[Tensor, "Z"]:
        """int64 training pixels of each block."""
        return torch.stack([(self.seen[:, z] * self.pixels).sum() for z in range(len(self.cells))])

    def views_of(self, block: int) -> Annotated[Tensor, "M"]:
        """int64 training views that a block learns from."""
        return self.views[(self.seen[:, block] & (self.pixels > 0)).flatten(1).any(1)]


def make_plan(scene: ParsedScene, layout: LayoutConfig) -> Plan:
    """Cut the scene and find out who sees what. Raises ConfigError where a block would have nothing to learn
    from.
    """
    # Geometry alone: no image is decoded to find out who sees what.
    sightings = find_sightings(scene)
    space = open_space(scene, sightings)
    cells = layout.build().cut(site_of(scene, space))
    parts: list[tuple[Tensor, Tensor]] = []
    for views in torch.split(scene.train, VIEWS):
        origin, direction, reach, pixels = tile_rays(scene, space, views, sightings)
        # Slab test: a block sees a tile whose rays meet it, border included, before they end.
        met = []
        for cell in cells:
            chart = chart_of(cell)
            enter, leave = slab(origin, direction, chart.low.to(origin), chart.high.to(origin))
            enter = enter.clamp_min(0)
            met.append((enter <= leave) & (enter <= reach) & (pixels > 0))
        parts.append((torch.stack(met, 1), pixels))
    seen, pixels = (torch.cat(column) for column in zip(*parts, strict=True))
    # A block that no pixel sees would learn nothing: it is part of the surroundings.
    used = []
    for block in range(len(cells)):
        if int((seen[:, block] * pixels).sum()):
            used.append(block)
    if not used:
        raise ConfigError(
            f"{scene.name}: no training view sees any block of this layout; choose another --blocks"
        )
    return Plan(
        space=space,
        cells=[cells[block] for block in used],
        views=scene.train,
        seen=seen[:, used],
        pixels=pixels,
    )


def bisect_sightings(scene: ParsedScene, count: int) -> list[Cell]:
    """`count` cells, each with about as many sightings of points. Raises ConfigError where the points do not
    allow that.
    """
    sightings = find_sightings(scene)
    if sightings is None or len(sightings.view) < SEEN * count:
        raise ConfigError(
            f"cells: {scene.name} has too few points of a reconstruction for {count} cells; train it in one piece"
        )
    # Sightings [O] come view by view; `ends` says where each view begins. `local` are their points along
    # principal axes.
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
        # The cell learns what lies within a border around it as well, so that nothing is missing at its
        # faces.
        inside = ((local >= low) & (local < high)).all(1)
        first, last = _extent(local[inside])
        border = BORDER * (last - first)
        near = ((local >= low - border) & (local < high + border)).all(1)
        # A view's window is around the points in the cell and its border, where enough of what it shows is
        # the cell's own.
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
        lows = window[:, :2]
        highs = window[:, :2] + window[:, 2:]
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
    """Start and length of a part of [0, size) around [first, last], at least LEAST long where there is
    room.
    """
    start = max(0, math.floor(first) - ROOM)
    length = min(max(math.ceil(last) + ROOM - start, LEAST), size)
    return min(start, size - length), length


_FORMAT = 6
_Windows = tuple[tuple[int, int, int, int, int], ...]
"""View, left, top, width, height of each."""


def write_cells(file: Path, cells: Sequence[Cell]) -> bool:
    """Write a partition; True where the file holds another one. Raises CheckpointError where that cannot be
    read.
    """
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
        found: list[Cell] = []
        for each in document["cells"]:
            found.append(
                Cell(
                    low=_corner(each["low"], -math.inf),
                    high=_corner(each["high"], math.inf),
                    border=_corner(each["border"], 0.0),
                    frame=frame,
                    windows={
                        v: (x, y, w, h)
                        for v, x, y, w, h in from_json(each["windows"], _Windows, path="windows")
                    },
                )
            )
        return found


def _corner(values: object, infinite: float) -> Annotated[Tensor, "3"]:
    numbers = from_json(values, tuple[float | None, float | None, float | None], path="cells")
    return torch.tensor([infinite if value is None else value for value in numbers], dtype=torch.float64)
