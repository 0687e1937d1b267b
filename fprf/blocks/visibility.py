"""Which pixels of which views a block must explain: those whose rays meet it before they end.

Images are looked at in tiles. Where a ray ends is known from the sparse points around: a tile's rays reach BEYOND times as far
as the farthest point that is seen in it or its neighbours, and without end where nothing is (the sky).
"""

from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.scene import TILES, Scene, Sightings, tile_of
from ..rendering.cameras import rays_through
from ..rendering.space import Space
from ..types import Boxes
from .windows import local

__all__ = ["BEYOND", "Tiles", "meets", "pixel_mask", "tile_rays", "visible"]

BEYOND = 1.25
"""Rays end at most so many times farther than what is seen around them."""


class Tiles(NamedTuple):
    """The rays through the middles of the tiles of M views, in the space; float32 is enough here."""

    origin: Annotated[Tensor, "M 3"]
    direction: Annotated[Tensor, "M TILES TILES 3"]
    reach: Annotated[Tensor, "M TILES TILES"]
    """Where the rays end at the latest, space units; inf where nothing is known."""
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
    """How many pixel centres (+0.5) lie in [low, high): what `tile_of` puts into a tile."""
    return ((high - 0.5).ceil() - (low - 0.5).ceil()).clamp_min(0).long()


def visible(tiles: Tiles, boxes: Boxes) -> Annotated[Tensor, "M Z TILES TILES"]:
    """Whether the rays of a tile meet each block, margins included, before they end."""
    return torch.stack([meets(tiles, boxes, block) for block in range(len(boxes.low))], 1)


def meets(tiles: Tiles, boxes: Boxes, block: int) -> Annotated[Tensor, "M TILES TILES"]:
    """`visible` for one block, by the slab test."""
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
