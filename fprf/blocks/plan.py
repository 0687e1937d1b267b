"""The plan of a large scene: its blocks, and for each one which tiles of which views it learns from.

Pure geometry of cameras and sparse points: made in seconds, before any image is decoded.

The space: Rays, sample spacing and density live here, the same for all blocks, so that densities blend as they are; each
block maps the points of this space to its own unit cube.

Visibility: Images are looked at in tiles. Where a ray ends is known from the sparse points around: a tile's rays reach BEYOND
times as far as the farthest point that is seen in it or its neighbours, and without end where nothing is (the sky).
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.bounds import FAR, NEAR, ROUNDING, axes
from ..datamanagers.scene import TILES, Scene, Sightings, find_sightings, tile_of
from ..errors import ConfigError, DataError
from ..fields.layouts import LayoutConfig
from ..io.images import Picture
from ..rendering.cameras import Cameras, rays_through
from ..rendering.space import Space
from ..types import Boxes, Site
from .routing import local, surroundings_of

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


def level_axes(cameras: Cameras) -> Annotated[Tensor, "3 3"]:
    """Rows: along the capture, across, up. Over a plane (drones) its normal is up; along a line (streets) the cameras' own."""
    offset = cameras.pose[:, :, 3] - cameras.pose[:, :, 3].mean(0)
    _, extent, rows = torch.linalg.svd(offset, full_matrices=True)
    if len(extent) < 3 or extent[2] > FLAT * extent[1] or extent[1] < WIDE * extent[0]:
        return axes(cameras)
    up, along = rows[2], rows[0]
    upright, ahead = cameras.pose[:, :, 1].mean(0), -cameras.pose[:, :, 2].mean(0)
    # Cameras stand upright, or look down: one of the two tells which side of the plane the sky is on.
    if (upright @ up - ahead @ up) < 0:
        up = -up
    if offset[-1] @ along < offset[0] @ along:
        along = -along
    return torch.stack([along, torch.linalg.cross(up, along), up])


def open_space(scene: Scene, sightings: Sightings | None) -> Space:
    """The space of kind `open`. Raises DataError where all cameras stand in one place and nothing says how far they see."""
    position = scene.cameras.pose[:, :, 3]
    centre, turn = position.mean(0), level_axes(scene.cameras)
    nearest = None
    if sightings is not None:
        unit = float(sightings.distance.median())
        nearest = float(sightings.distance.sort().values[int(NEAREST * len(sightings.distance))])
    elif scene.depths is not None:
        unit, nearest = float(scene.depths.prod(-1).sqrt().median()), float(scene.depths[:, 0].amin())
    else:
        apart = torch.cdist(position[:: max(1, len(position) // SOME)], position)
        unit = SPACINGS * float(apart.topk(2, largest=False).values[:, 1].median()) if len(position) > 1 else 0.0
    if unit <= ROUNDING * max(1.0, float(position.abs().amax())):
        raise DataError(f"{scene.name}: all cameras stand in one place and there are no points; capture from several places")
    near = NEAR if nearest is None else min(NEAR, max(1e-3, 0.5 * nearest / unit))
    first, second, third = ((float(row[0]), float(row[1]), float(row[2])) for row in turn)
    middle = (float(centre[0]), float(centre[1]), float(centre[2]))
    return Space("open", middle, (first, second, third), 1 / unit, near, FAR)


def site_of(scene: Scene, space: Space) -> Site:
    """Training cameras and sparse points in the space."""
    turn = torch.tensor(space.rotation, dtype=torch.float64)
    centre = torch.tensor(space.centre, dtype=torch.float64)
    cameras = scene.cameras.select(scene.train)
    points = scene.points if scene.points is not None else centre.new_zeros(0, 3)
    return Site(
        ((cameras.pose[:, :, 3] - centre) @ turn.T) * space.scale,
        cameras.size.prod(-1),
        ((points - centre) @ turn.T) * space.scale,
        1 / space.scale,
    )


BEYOND = 1.25
"""Rays end at most so many times farther than what is seen around them."""


class Tiles(NamedTuple):
    """The rays through the middles of the tiles of M views, in the space; float32 is enough here."""

    origin: Annotated[Tensor, "M 3"]
    direction: Annotated[Tensor, "M TILES TILES 3"]
    reach: Annotated[Tensor, "M TILES TILES"]
    """Upper bounds of the lengths of rays, space units; inf where nothing is known."""
    pixels: Annotated[Tensor, "M TILES TILES"]
    """int64 pixels of each tile; 0 outside of the image."""


def tile_rays(scene: Scene, space: Space, views: Annotated[Tensor, "M"], sightings: Sightings | None) -> Tiles:
    """Tiles [row, column] of some views."""
    cameras = scene.cameras
    size = cameras.size[views].double()
    side = size.amax(1) / TILES
    steps = torch.arange(TILES, dtype=torch.float64)
    low = side[:, None] * steps
    columns, rows = (_centres(low, torch.minimum(low + side[:, None], s[:, None])) for s in size.T)
    middle = low + side[:, None] / 2
    x, y = (torch.minimum(middle, s[:, None] - 0.5) for s in size.T)
    pixel = torch.stack([x[:, None, :].expand(-1, TILES, -1), y[:, :, None].expand(-1, -1, TILES)], -1)
    which = views[:, None, None].expand(-1, TILES, TILES).reshape(-1)
    origin, direction = rays_through(cameras, which, pixel.reshape(-1, 2))
    rays = space.rays(origin, direction)
    return Tiles(
        rays.origin.view(-1, TILES, TILES, 3)[:, 0, 0],
        rays.direction.view(-1, TILES, TILES, 3),
        _reach(scene, space, views, sightings),
        rows[:, :, None] * columns[:, None, :],
    )


def _centres(low: Tensor, high: Tensor) -> Tensor:
    """Count pixel centres (+0.5) in [low, high), as `tile_of` puts them into tiles."""
    return ((high - 0.5).ceil() - (low - 0.5).ceil()).clamp_min(0).long()


def meets(tiles: Tiles, boxes: Boxes, block: int) -> Annotated[Tensor, "M TILES TILES"]:
    """True where the rays of a tile meet a block, margins included, before they end: the slab test."""
    low, high = (boxes.low[block] - boxes.margin).to(tiles.origin), (boxes.high[block] + boxes.margin).to(tiles.origin)
    origin = local(tiles.origin, boxes.turn[block])[:, None, None]
    direction = local(tiles.direction.reshape(-1, 3), boxes.turn[block]).view(tiles.direction.shape)
    safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
    a, b = (low - origin) / safe, (high - origin) / safe
    enter, leave = torch.minimum(a, b).amax(-1).clamp_min(0), torch.maximum(a, b).amin(-1)
    return (enter <= leave) & (enter <= tiles.reach) & (tiles.pixels > 0)


def pixel_mask(seen: Annotated[Tensor, "TILES TILES"], size: tuple[int, int]) -> Annotated[Tensor, "H W"]:
    """The pixels of the tiles that are set, for an image of (width, height)."""
    width, height = size
    side = max(size) / TILES
    column = ((torch.arange(width, dtype=torch.float64) + 0.5) / side).long().clamp(max=TILES - 1)
    row = ((torch.arange(height, dtype=torch.float64) + 0.5) / side).long().clamp(max=TILES - 1)
    return seen[row][:, column]


def _reach(scene: Scene, space: Space, views: Tensor, sightings: Sightings | None) -> Tensor:
    far = torch.zeros(len(views), TILES, TILES)
    if sightings is None:
        return torch.full_like(far, torch.inf)
    slot = torch.full((len(scene.cameras),), -1, dtype=torch.int64)
    slot[views] = torch.arange(len(views))
    mine = slot[sightings.view] >= 0
    view, pixel = sightings.view[mine], sightings.pixel[mine]
    column, row = tile_of(scene.cameras, view, pixel).unbind(1)
    at = (slot[view] * TILES + row) * TILES + column
    far.view(-1).scatter_reduce_(0, at, (sightings.distance[mine] * space.scale).float(), "amax")
    around = F.max_pool2d(far[:, None], 3, stride=1, padding=1)[:, 0]
    return torch.where(around > 0, BEYOND * around, torch.inf)


VIEWS = 256
"""Views whose tiles are looked at together: bounds memory, changes nothing."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Z blocks of a scene, T training views."""

    space: Space
    boxes: Boxes
    views: Annotated[Tensor, "T"]
    """int64 training views of the scene."""
    seen: Annotated[Tensor, "T Z TILES TILES"]
    """Tiles of each view that each block learns from."""
    pixels: Annotated[Tensor, "T TILES TILES"]
    """int64 pixels of each tile."""

    @property
    def cut(self) -> bool:
        """True for more than one block."""
        return len(self.boxes.low) > 1

    @property
    def rays(self) -> Annotated[Tensor, "Z"]:
        """int64 training pixels of each block."""
        return torch.stack([(self.seen[:, z] * self.pixels).sum() for z in range(len(self.boxes.low))])

    def views_of(self, block: int) -> Annotated[Tensor, "M"]:
        """int64 training views that a block learns from."""
        return self.views[(self.seen[:, block] & (self.pixels > 0)).flatten(1).any(1)]


def make_plan(scene: Scene, layout: LayoutConfig) -> Plan:
    """Cut the scene and find out who sees what. Raises ConfigError where a block would have nothing to learn from."""
    sightings = find_sightings(scene)
    space = open_space(scene, sightings)
    boxes = layout.build().cut(site_of(scene, space))
    seen, pixels = [], []
    for views in torch.split(scene.train, VIEWS):
        tiles = tile_rays(scene, space, views, sightings)
        seen.append(torch.stack([meets(tiles, boxes, block) for block in range(len(boxes.low))], 1))
        pixels.append(tiles.pixels)
    whole = Plan(space=space, boxes=boxes, views=scene.train, seen=torch.cat(seen), pixels=torch.cat(pixels))
    used = (whole.rays > 0).nonzero()[:, 0]
    if not len(used):
        raise ConfigError(f"{scene.name}: no training view sees any block of this layout; choose another --blocks")
    kept = Boxes(boxes.low[used], boxes.high[used], boxes.turn[used], boxes.margin)
    return replace(whole, boxes=kept, seen=whole.seen[:, used])


def boxes_to(boxes: Boxes) -> dict[str, Any]:
    """As JSON."""
    return {"low": boxes.low.tolist(), "high": boxes.high.tolist(), "turn": boxes.turn.tolist(), "margin": boxes.margin}


def boxes_from(value: dict[str, Any]) -> Boxes:
    """Out of JSON. Raises ValueError or KeyError where it is something else."""
    low, high, turn = (torch.tensor(value[key], dtype=torch.float64) for key in ("low", "high", "turn"))
    if low.ndim != 2 or low.shape != high.shape or tuple(turn.shape) != (len(low), 3, 3) or low.shape[1] != 3:
        raise ValueError(f"boxes of shapes {tuple(low.shape)}, {tuple(high.shape)}, {tuple(turn.shape)}")
    return Boxes(low, high, turn, float(value["margin"]))


SIDE = 1200
"""Pixels of the longer side of the ground plan."""
BORDER = 60
"""Pixels around it."""
POINTS = 200_000
"""Points drawn at most."""
_PAPER, _INK, _DUST, _CAMERA = (250, 249, 246), (40, 42, 46), (176, 172, 164), (178, 58, 40)
_COLOURS = ((0, 114, 178), (0, 158, 115), (204, 121, 167), (213, 94, 0), (86, 180, 233), (148, 103, 189))


def top_view(scene: Scene, plan: Plan) -> Picture:
    """The plan as a picture; axis 0 runs to the right, axis 1 upwards."""
    site = site_of(scene, plan.space)
    whole = surroundings_of(plan.boxes)
    margin = plan.boxes.margin + 0.5
    low, high = whole.low[:2] - margin, whole.high[:2] + margin
    step = float((high - low).amax()) / SIDE
    width, height = (math.ceil(float(extent) / step) + 2 * BORDER for extent in high - low)
    sheet: Picture = np.full((height, width, 3), _PAPER, np.uint8)

    def place(points: Tensor) -> np.ndarray:
        flat = (points[..., :2].double() - low) / step
        return torch.stack([flat[..., 0] + BORDER, height - BORDER - flat[..., 1]], -1).round().numpy().astype(np.int64)

    dots = place(site.points[:: max(1, len(site.points) // POINTS)])
    dots = dots[((dots >= 0) & (dots < (width, height))).all(1)]
    sheet[dots[:, 1], dots[:, 0]] = _DUST
    _boxes(sheet, plan, place)
    turn = torch.tensor(plan.space.rotation, dtype=torch.float64)
    ahead = -scene.cameras.pose[scene.train][:, :, 2] @ turn.T
    long = 10 * step
    for start, end in zip(place(site.position).tolist(), place(site.position + long * ahead).tolist(), strict=True):
        cv2.line(sheet, start, end, _CAMERA, 1, cv2.LINE_AA)
        cv2.circle(sheet, start, 2, _CAMERA, -1, cv2.LINE_AA)
    _scale(sheet, step / plan.space.scale)
    return sheet


def _boxes(sheet: Picture, plan: Plan, place) -> None:  # type: ignore[no-untyped-def]
    for block in range(len(plan.boxes.low)):
        colour = _COLOURS[block % len(_COLOURS)]
        low, high, turn = plan.boxes.low[block], plan.boxes.high[block], plan.boxes.turn[block]
        for margin, thick in ((plan.boxes.margin, 1), (0.0, 2)):
            ends = torch.stack([low - margin, high + margin])
            corners = torch.stack([ends[[0, 1, 1, 0], 0], ends[[0, 0, 1, 1], 1], ends[[0, 0, 0, 0], 2]], 1)
            ring = place(corners @ turn).astype(np.int32)
            cv2.polylines(sheet, [ring], True, colour, thick, cv2.LINE_AA)
        x, y = place((low + high) / 2 @ turn).tolist()
        cv2.putText(sheet, f"{block:02d}", (x - 16, y + 10), cv2.FONT_HERSHEY_SIMPLEX, 0.9, colour, 2, cv2.LINE_AA)


def _scale(sheet: Picture, unit: float) -> None:
    """A bar of a round length in world units; `unit` of them make a pixel."""
    longest = 0.25 * sheet.shape[1] * unit
    power = 10.0 ** math.floor(math.log10(longest))
    length = max(k * power for k in (1, 2, 5) if k * power <= longest)
    pixels, y = round(length / unit), sheet.shape[0] - 24
    cv2.line(sheet, (BORDER, y), (BORDER + pixels, y), _INK, 2, cv2.LINE_AA)
    cv2.putText(
        sheet, f"{length:g} world units", (BORDER + pixels + 10, y + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA
    )
