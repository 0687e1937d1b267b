"""What lies beyond reach, as points on a dome round the scene: without it a splat viewer shows black sky."""

from typing import Annotated

import torch
from torch import Tensor

from ..rendering.cameras import pixel_grid, rays_through
from .fusion import Cloud
from .sights import Sights
from .voxels import cells, keys, pooled

__all__ = ["dome"]

_COARSE = 2.0
"""Edge of a dome's cell, in pixels: what is far is smooth."""
_LOOSE = 1.5
"""Distance of neighbours, in cells: a cubic lattice cuts a sphere unevenly, and a gap in the sky is black."""
_FAR = 3.0
"""Radius of the dome, in distances of the outermost of the scene's points."""


def dome(sights: Sights, cloud: Cloud) -> Cloud | None:
    """Points in the directions in which views see nothing within reach, facing inwards; None where all see something."""
    cameras = sights.cameras
    directions, views = [], []
    for index, depth in enumerate(sights.depth):
        pixel = pixel_grid(cameras, index)[depth.isinf().view(-1)]
        views.append(torch.full((len(pixel),), index))
        directions.append(rays_through(cameras, views[-1], pixel)[1])
    direction, view = torch.cat(directions), torch.cat(views)
    if len(direction) == 0:
        return None
    edge = float(_COARSE / cameras.focal.mean())
    key, group = torch.unique(keys(cells(direction, edge)), return_inverse=True)
    mean = torch.nn.functional.normalize(pooled(group, direction, torch.ones(len(direction)), len(key)), dim=-1)
    first = torch.full((len(key),), len(direction)).scatter_reduce(0, group, torch.arange(len(direction)), "amin")
    width = torch.full((len(key),), edge, dtype=torch.float64)
    centre = cameras.pose[:, :, 3].mean(0)
    radius = _FAR * _extent(cloud.point, centre)
    return Cloud(centre + radius * mean, -mean.float(), radius * width, _LOOSE * radius * width, view[first])


def _extent(points: Annotated[Tensor, "N 3"], centre: Annotated[Tensor, "3"]) -> float:
    """Distance of the outermost point."""
    return float(torch.linalg.vector_norm(points - centre, dim=-1).amax())
