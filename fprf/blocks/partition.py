"""The frames that scenes are cut in, blocks of fields with what each learns from, and the file of a partition.

Blocks lie in the scene's space, the same for all, so that their densities blend as they are; what none of them
holds is surroundings. Layouts say where they lie (`layouts`); cells of Gaussians are in `windows`.

Which tiles of which views a block learns from follows from cameras and sparse points alone, before any image
is decoded. A tile's rays reach BEYOND_RATIO times as far as the farthest point that is seen in it or its
neighbours, and without end where nothing is (the sky).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.bounds import FAR, NEAR, ROUNDING, axes
from ..datamanagers.scene import TILES, ParsedScene, Sightings, find_sightings, tile_of
from ..errors import ConfigError, DataError
from ..io.atomic import write_json
from ..io.strict_json import open_json
from ..plugins.codec import from_json
from ..rendering.cameras import Cameras, rays_through
from ..rendering.space import Space, slab
from ..types import Cell, Site, Window
from .config import LayoutConfig
from .layouts import bounds
from .routing import chart_of

MAX_FLATNESS = 0.3
"""Cameras spread over a plane if their third extent is below this share of their second; by eye."""
MIN_FLAT_WIDTH_SHARE = 0.2
"""... and that one above this share of the first; else along a line; by eye."""
NEAREST_SHARE = 0.001
"""Share of the sightings that may lie closer than twice the nearest distance that is looked at; by eye."""
SPACINGS_SEEN = 10.0
"""Without points views are taken to see this many times the distance to the next camera; by eye."""
MEASURED_CAMERAS = 512
"""That distance is measured for about so many of them: bounds the time."""
BEYOND_RATIO = 1.25
"""Rays end at most so many times farther than what is seen around them; by eye."""
VIEWS_AT_ONCE = 256
"""Views whose tiles are looked at together: bounds memory, changes nothing."""
_PARTITION_FORMAT = 6
"""Version of blocks.json and cells.json."""
_Windows = tuple[tuple[int, int, int, int, int], ...]
"""View, left, top, width, height of each."""


def level_axes(cameras: Cameras) -> Annotated[Tensor, "3 3"]:
    """Rows: along the capture, across, up. Over a plane (drones) its normal is up; along a line (streets) the
    cameras' own.
    """
    offset = cameras.pose[:, :, 3] - cameras.pose[:, :, 3].mean(0)
    _, extent, rows = torch.linalg.svd(offset, full_matrices=True)
    if (
        len(extent) < 3
        or extent[2] > MAX_FLATNESS * extent[1]
        or extent[1] < MIN_FLAT_WIDTH_SHARE * extent[0]
    ):
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


def principal_axes(points: Annotated[Tensor, "O 3"]) -> Annotated[Tensor, "3 3"]:
    """Rows: the axes of points, the longest first."""
    centred = points - points.mean(0)
    vectors: Tensor = torch.linalg.eigh(centred.T @ centred).eigenvectors
    return vectors.T.flip(0).contiguous()


def open_space(scene: ParsedScene, sightings: Sightings | None, *, principal: bool = False) -> Space:
    """The space of kind `open`, level, or along the principal axes of what views see of the points.

    Raises DataError where all cameras stand in one place and nothing says how far they see.
    """
    # A unit is the distance that views commonly see: of points, else as the capture says, else of the
    # cameras' spacing.
    position = scene.cameras.pose[:, :, 3]
    centre = position.mean(0)
    if principal and sightings is not None:
        turn = principal_axes(sightings.point)
    else:
        turn = level_axes(scene.cameras)
    nearest = None
    if sightings is not None:
        unit = float(sightings.distance.median())
        nearest = float(sightings.distance.sort().values[int(NEAREST_SHARE * len(sightings.distance))])
    elif scene.depths is not None:
        unit = float(scene.depths.prod(-1).sqrt().median())
        nearest = float(scene.depths[:, 0].amin())
    else:
        apart = torch.cdist(position[:: max(1, len(position) // MEASURED_CAMERAS)], position)
        if len(position) > 1:
            unit = SPACINGS_SEEN * float(apart.topk(2, largest=False).values[:, 1].median())
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


def site_of(scene: ParsedScene, space: Space, sightings: Sightings | None = None) -> Site:
    """Training cameras, sparse points and what views see of them in the space."""
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
        seen=None if sightings is None else ((sightings.point - centre) @ turn.T) * space.scale,
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
        reach = torch.where(around > 0, BEYOND_RATIO * around, reach)
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
        parts = []
        for z in range(len(self.cells)):
            parts.append((self.seen[:, z] * self.pixels).sum())
        return torch.stack(parts)

    def views_of(self, block: int) -> Annotated[Tensor, "M"]:
        """int64 training views that a block learns from."""
        return self.views[(self.seen[:, block] & (self.pixels > 0)).flatten(1).any(1)]


def _bounded(cells: Sequence[Cell], site: Site) -> list[Cell]:
    """Cells whose faces are all finite: those without an end end where the region does.

    Cells outside of the region are left out; planes of fields have no room for what has no end.
    """
    low, high = bounds(site)
    bounded = []
    for cell in cells:
        first = torch.where(cell.low.isfinite(), cell.low, low - cell.border)
        last = torch.where(cell.high.isfinite(), cell.high, high + cell.border)
        if bool((first < last).all()):
            bounded.append(replace(cell, low=first, high=last))
    return bounded


def make_plan(scene: ParsedScene, layout: LayoutConfig) -> Plan:
    """Cut the scene and find out who sees what. Raises ConfigError where a block would have nothing to learn
    from.
    """
    # Geometry alone: no image is decoded to find out who sees what.
    sightings = find_sightings(scene)
    space = open_space(scene, sightings, principal=layout.principal)
    site = site_of(scene, space, sightings)
    cells = _bounded(layout.build().cut(site), site)
    parts: list[tuple[Tensor, Tensor]] = []
    for views in torch.split(scene.train, VIEWS_AT_ONCE):
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


def write_cells(file: Path, cells: Sequence[Cell]) -> bool:
    """Write a partition; True where the file holds another one. Raises CheckpointError where that cannot be
    read.
    """
    rows = []
    for cell in cells:
        row = {
            "low": _finite(cell.low),
            "high": _finite(cell.high),
            "border": cell.border.tolist(),
            "windows": [[view, *window] for view, window in cell.windows.items()],
        }
        rows.append(row)
    document = {"format": _PARTITION_FORMAT, "frame": cells[0].frame.tolist(), "cells": rows}
    other = False
    if file.is_file():
        with open_json(file, "remove it and train again") as before:
            other = bool(before != document)
    write_json(file, document)
    return other


def read_cells(file: Path) -> list[Cell]:
    """Read a partition. Raises CheckpointError."""
    with open_json(file, "train the scene again with --output ANOTHER") as document:
        if document["format"] != _PARTITION_FORMAT:
            raise ValueError(f"format {document['format']!r}, this fprf reads {_PARTITION_FORMAT}")
        frame = torch.tensor(document["frame"], dtype=torch.float64).reshape(3, 3)
        found: list[Cell] = []
        for each in document["cells"]:
            windows: dict[int, Window] = {}
            for view, *window in from_json(each["windows"], _Windows, path="windows"):
                left, top, width, height = window
                windows[view] = (left, top, width, height)
            low = _corner(each["low"], -math.inf)
            high = _corner(each["high"], math.inf)
            border = _corner(each["border"], 0.0)
            found.append(Cell(low=low, high=high, border=border, frame=frame, windows=windows))
        return found


def _finite(corner: Annotated[Tensor, "3"]) -> list[float | None]:
    """Numbers of a corner; None for infinite ones, which JSON does not know."""
    found: list[float | None] = []
    for x in corner.tolist():
        found.append(x if math.isfinite(x) else None)
    return found


def _corner(values: object, infinite: float) -> Annotated[Tensor, "3"]:
    numbers = from_json(values, tuple[float | None, float | None, float | None], path="cells")
    parts = []
    for value in numbers:
        parts.append(infinite if value is None else value)
    return torch.tensor(parts, dtype=torch.float64)
