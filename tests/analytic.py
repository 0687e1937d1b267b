"""Views of analytic surfaces with exact depth: a sphere, and planes."""

import math

import torch
from torch import Tensor

from fprf.export.mesh import Maps
from fprf.rendering.cameras import Cameras, grid_rays, ideal_cameras
from fprf.rendering.paths import look_at

RADIUS = 1.0
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def ring(count: int = 8, *, size: tuple[int, int] = (48, 40)) -> Cameras:
    """Pinhole views all round the origin, 4 away and a little from above."""
    k = torch.arange(count, dtype=torch.float64)
    angle = 2 * math.pi * k / count
    place = torch.stack([4 * angle.cos(), 4 * angle.sin(), 1 + 0.3 * (k % 2)], 1)
    return ideal_cameras(look_at(place, torch.zeros_like(place), UP), 50.0, size)


def plane_depth(cameras: Cameras, view: int, normal: Tensor, offset: float) -> Tensor:
    """Distance to the plane normal . x = offset; infinite where a ray does not meet it."""
    origin, direction = grid_rays(cameras, view)
    way = (offset - origin @ normal) / (direction @ normal)
    width, height = cameras.size[view].tolist()
    return torch.where(way > 0, way, torch.inf).view(height, width)


def sphere_depth(cameras: Cameras, view: int) -> Tensor:
    """Distance to the sphere round the origin."""
    origin, direction = grid_rays(cameras, view)
    along = (origin * direction).sum(-1)
    inside = along.square() - (origin.square().sum(-1) - RADIUS**2)
    width, height = cameras.size[view].tolist()
    return torch.where(inside > 0, -along - inside.clamp_min(0).sqrt(), torch.inf).view(height, width)


def globe(count: int = 8) -> Maps:
    """The sphere, whose colours are its places, from [-1, 1] to [0, 1]."""
    cameras = ring(count)
    depths = [sphere_depth(cameras, view).float() for view in range(count)]
    places = []
    for view, depth in enumerate(depths):
        origin, direction = grid_rays(cameras, view)
        place = origin + direction * depth.view(-1, 1)
        places.append((0.5 + 0.5 * place).nan_to_num(0.0, 0.0, 0.0).float().view(*depth.shape, 3))
    return Maps(cameras, depths, places)
