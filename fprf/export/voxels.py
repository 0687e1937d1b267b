"""Points in voxels: keys, one point a voxel, and how far neighbours are apart. Voxels have edges `base * 2**level`.

Keys are one int64 a voxel: 5 bits of level and 19 bits an axis, so a scene may span 524,288 voxels of its finest level.
"""

from typing import Annotated

import torch
from torch import Tensor

__all__ = ["LEVELS", "SPAN", "cells", "finest_alone", "keys", "pooled", "spacing"]

LEVELS = 12
"""Levels that are told apart: the coarsest voxels are 2048 times as wide as the finest."""
SPAN = 1 << 18
"""Voxels to either side of the origin that keys can tell apart."""
_CROWD = 8
"""Points of one cell that are looked at as neighbours: as many as there are voxels in it."""
_CHUNK = 1 << 14


def cells(points: Annotated[Tensor, "N 3"], edge: Annotated[Tensor, "N"] | float) -> Annotated[Tensor, "N 3"]:
    """Integer coordinates of the voxels that points lie in."""
    return (points / (edge[:, None] if isinstance(edge, Tensor) else edge)).floor().long()


def keys(cell: Annotated[Tensor, "N 3"], level: Annotated[Tensor, "N"] | int = 0) -> Annotated[Tensor, "N"]:
    """One integer a voxel; coordinates must lie within `SPAN`."""
    x, y, z = (cell + SPAN).unbind(-1)
    return ((level * 2 * SPAN + x) * 2 * SPAN + y) * 2 * SPAN + z


def pooled(
    group: Annotated[Tensor, "N"], values: Annotated[Tensor, "N C"], weight: Annotated[Tensor, "N"], groups: int
) -> Annotated[Tensor, "groups C"]:
    """Weighted mean of the values of each group, in float64."""
    share = weight.double()
    total = share.new_zeros(groups).index_add(0, group, share).clamp_min(1e-300)
    sums = share.new_zeros(groups, values.shape[1]).index_add(0, group, values.double() * share[:, None])
    return sums / total[:, None]


def finest_alone(points: Annotated[Tensor, "N 3"], level: Annotated[Tensor, "N"], base: float) -> Annotated[Tensor, "N"]:
    """True for points whose voxel holds no point of a finer level: one surface is not covered twice."""
    alone = torch.ones(len(points), dtype=torch.bool)
    for coarse in sorted(set(level.tolist()))[1:]:
        edge = base * 2**coarse
        finer, here = level < coarse, level == coarse
        covered = torch.isin(keys(cells(points[here], edge)), keys(cells(points[finer], edge)))
        alone[here.nonzero()[:, 0][covered]] = False
    return alone


def spacing(points: Annotated[Tensor, "N 3"], edge: Annotated[Tensor, "N"], neighbours: int = 4) -> Annotated[Tensor, "N"]:
    """Mean distance of each point to its nearest neighbours; infinite where it has fewer within two edges of its own."""
    result = torch.full((len(points),), torch.inf, dtype=points.dtype)
    shifts = torch.stack(torch.meshgrid(*(torch.arange(-1, 2),) * 3, indexing="ij"), -1).view(-1, 3)
    for width in sorted(set(edge.tolist())):
        cell = cells(points, 2 * width)
        sorted_keys, order = keys(cell).sort()
        for mine in (edge == width).nonzero()[:, 0].split(_CHUNK):
            start = torch.searchsorted(sorted_keys, keys(cell[mine, None] + shifts))
            index = (start[:, :, None] + torch.arange(_CROWD)).clamp(max=len(points) - 1)
            there = order[index]
            wanted = keys(cell[mine, None] + shifts)[:, :, None] == sorted_keys[index]
            wanted &= there != mine[:, None, None]
            # The last index may come several times where it was clamped.
            wanted &= (start[:, :, None] + torch.arange(_CROWD)) < len(points)
            away = torch.linalg.vector_norm(points[there] - points[mine, None, None], dim=-1)
            away = torch.where(wanted & (away <= 2 * width), away, torch.inf).view(len(mine), -1)
            result[mine] = away.topk(neighbours, largest=False).values.mean(-1)
    return result
