"""Views of analytic surfaces with exact depth: a sphere on a floor, and planes."""

import math

import torch
from torch import Tensor

from fprf.export.depth_maps import DepthMaps
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through

RADIUS = 1.0


def looking(place: Tensor, target: Tensor) -> Tensor:
    """A pose [3 4] at a place that looks at a target, z up."""
    back = torch.nn.functional.normalize(place - target, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=back.dtype), back), dim=-1)
    return torch.stack([right, torch.linalg.cross(back, right), back, place], 1)


def ring(count: int = 8, *, away: float = 4.0, size: tuple[int, int] = (48, 40), focal: float = 50.0) -> Cameras:
    """Pinhole views all round the origin, a little from above."""
    poses = []
    for k in range(count):
        a = 2 * math.pi * k / count
        place = torch.tensor([away * math.cos(a), away * math.sin(a), 1.0 + 0.3 * (k % 2)], dtype=torch.float64)
        poses.append(looking(place, torch.zeros(3, dtype=torch.float64)))
    return Cameras(
        pose=torch.stack(poses),
        focal=torch.full((count, 2), focal, dtype=torch.float64),
        centre=torch.tensor([size], dtype=torch.float64).repeat(count, 1) / 2,
        size=torch.tensor([size]).repeat(count, 1),
        distortion=torch.zeros(count, 6, dtype=torch.float64),
        lens=torch.zeros(count, dtype=torch.int64),
    )


def _rays(cameras: Cameras, view: int) -> tuple[Tensor, Tensor]:
    pixel = pixel_grid(cameras, view)
    return rays_through(cameras, torch.full((len(pixel),), view), pixel)


def plane_depth(cameras: Cameras, view: int, normal: Tensor, offset: float) -> Tensor:
    """Distance to the plane normal . x = offset; infinite where a ray does not meet it."""
    origin, direction = _rays(cameras, view)
    way = (offset - origin @ normal) / (direction @ normal)
    width, height = cameras.size[view].tolist()
    return torch.where(way > 0, way, torch.inf).view(height, width)


def sphere_depth(cameras: Cameras, view: int, radius: float = RADIUS) -> Tensor:
    """Distance to a sphere round the origin."""
    origin, direction = _rays(cameras, view)
    along = (origin * direction).sum(-1)
    inside = along.square() - (origin.square().sum(-1) - radius**2)
    width, height = cameras.size[view].tolist()
    return torch.where(inside > 0, -along - inside.clamp_min(0).sqrt(), torch.inf).view(height, width)


def globe(count: int = 8, *, floor: float | None = None) -> DepthMaps:
    """The sphere, and the floor z = floor if there is one."""
    cameras = ring(count)
    maps = []
    for view in range(count):
        depth = sphere_depth(cameras, view)
        if floor is not None:
            up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
            depth = torch.minimum(depth, plane_depth(cameras, view, up, floor))
        maps.append(depth.float())
    return DepthMaps(cameras, tuple(maps))
