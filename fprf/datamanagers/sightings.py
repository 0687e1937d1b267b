"""Which sparse points each training view sees, where in its image, and how far away.

Reconstructions say so. Where one does not, points are projected and only the nearest layer counts: in each tile of an image
those no farther than LAYER times the nearest. It takes the wall before the street behind it, which is what depths are for.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..rendering.cameras import Cameras, project
from .scene import Scene

__all__ = ["Sightings", "find_sightings", "tile_of"]

TILES = 16
"""Tiles across the longer side of an image."""
LAYER = 1.15
"""Points up to so many times the nearest distance in their tile are seen."""
PROJECTIONS = 1 << 26
"""Points are thinned so that no more projections than these are made."""


class Sightings(NamedTuple):
    """O sightings of points by training views, in the order of the views; float64."""

    view: Annotated[Tensor, "O"]
    """int64 index of the view in the scene."""
    point: Annotated[Tensor, "O 3"]
    """In the world."""
    pixel: Annotated[Tensor, "O 2"]
    """x, y, inside the image."""
    distance: Annotated[Tensor, "O"]
    """World distance from the camera, along the ray."""


def find_sightings(scene: Scene) -> Sightings | None:
    """The sightings of the training views; None without sparse points or where none is in any view."""
    if scene.points is None or not len(scene.points):
        return None
    if scene.seen is not None:
        members = torch.zeros(len(scene.cameras), dtype=torch.bool)
        members[scene.train] = True
        kept = scene.seen[members[scene.seen[:, 0]]]
        kept = kept[kept[:, 0].argsort(stable=True)]
        found = _sighted(scene.cameras, kept[:, 0], scene.points[kept[:, 1]])
    else:
        points = scene.points[:: max(1, len(scene.points) * len(scene.train) // PROJECTIONS)]
        parts = [_nearest(scene.cameras, view, points) for view in scene.train.tolist()]
        found = Sightings(*(torch.cat(columns) for columns in zip(*parts, strict=True)))
    return found if len(found.view) else None


def tile_of(cameras: Cameras, view: Annotated[Tensor, "O"], pixel: Annotated[Tensor, "O 2"]) -> Annotated[Tensor, "O 2"]:
    """Column and row of the tile that a pixel lies in: TILES along the longer side, square."""
    size = cameras.size[view]
    side = size.amax(-1, keepdim=True).double() / TILES
    return torch.minimum((pixel / side).long(), ((size.double() / side).ceil().long() - 1)).clamp_min(0)


def _sighted(cameras: Cameras, view: Tensor, points: Tensor) -> Sightings:
    """Those of the pairs whose point falls into its image."""
    pixel, depth = project(cameras, view, points)
    size = cameras.size[view].to(pixel)
    inside = (depth > 0) & ((pixel >= 0) & (pixel < size)).all(1)  # NaN is never inside
    distance = (points - cameras.pose[view, :, 3]).norm(dim=-1)
    return Sightings(view[inside], points[inside], pixel[inside], distance[inside])


def _nearest(cameras: Cameras, view: int, points: Tensor) -> Sightings:
    """The nearest layer of all points in a view."""
    found = _sighted(cameras, torch.full((len(points),), view), points)
    column, row = tile_of(cameras, found.view, found.pixel).unbind(1)
    tile = row * TILES + column
    least = found.distance.new_full((TILES * TILES,), torch.inf).scatter_reduce(0, tile, found.distance, "amin")
    front = found.distance <= LAYER * least[tile]
    return Sightings(*(x[front] for x in found))
