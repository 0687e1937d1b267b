"""Surface normals of a rendered view, from its depth alone."""

from typing import Annotated

import torch
from torch import Tensor

from .cameras import Cameras, pixel_grid, rays_through

__all__ = ["normals"]


def normals(cameras: Cameras, view: int, depth: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "H W 3"]:
    """Unit normals in world axes, facing the camera; 0 where depth is not positive and finite, or there is no neighbour.

    `depth` is the distance along the unit ray. Of the two neighbours in each direction the nearer one in space counts, so
    that an edge belongs to one of its sides.
    """
    pixel = pixel_grid(cameras, view)
    origin, direction = rays_through(cameras, torch.full((len(pixel),), view), pixel)
    height, width = depth.shape
    solid = torch.isfinite(depth) & (depth > 0)
    far = torch.where(solid, depth, torch.zeros_like(depth)).double()
    points = origin.view(height, width, 3) + direction.view(height, width, 3) * far[..., None]
    # Steps follow the pixels' order, so that of what a camera sees they turn as its pixels do: the normal faces it. Where
    # there is no step the product is 0, and stays so.
    normal = torch.linalg.cross(_step(points, solid, 0), _step(points, solid, 1))
    return torch.nn.functional.normalize(normal, dim=-1, eps=1e-300).float()


def _step(points: Tensor, solid: Tensor, axis: int) -> Tensor:
    """From each point to the next one along an axis, or from the one before, whichever is shorter; 0 where there is none."""
    count = points.shape[axis]
    both = (solid.narrow(axis, 1, count - 1) & solid.narrow(axis, 0, count - 1))[..., None]
    gaps = points.narrow(axis, 1, count - 1) - points.narrow(axis, 0, count - 1)
    gaps = torch.where(both, gaps, torch.full_like(gaps, torch.inf))
    edge = torch.full_like(points.narrow(axis, 0, 1), torch.inf)
    ahead, behind = torch.cat([gaps, edge], axis), torch.cat([edge, gaps], axis)
    shorter = ahead.norm(dim=-1, keepdim=True) <= behind.norm(dim=-1, keepdim=True)
    step = torch.where(shorter, ahead, behind)
    return torch.where(torch.isfinite(step), step, torch.zeros_like(step))
