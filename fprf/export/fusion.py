"""Depth maps to one cloud of surface points: checked against other views, one point a voxel, with normals.

A pixel's point stays where other views that look there see a surface at the same distance, and few look through it. Voxels
are as wide as the pixels that hit them, in powers of two: what is near is fine, what is far is coarse.
"""

from collections.abc import Callable
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError
from .sights import Sights, Surface, gaps, surface
from .voxels import LEVELS, SPAN, cells, finest_alone, keys, pooled, spacing

__all__ = ["Cloud", "fuse", "joined", "partners"]

_GRAZING = 0.04
"""Pixels that see their surface at a smaller cosine are left out: their depth is as uncertain as it is long."""
_PARTNERS = 8
"""Other views that a view is checked against."""
_PROBES = 256
"""Points of a view by which its partners are found."""


class Cloud(NamedTuple):
    """N points of a scene's surfaces."""

    point: Annotated[Tensor, "N 3"]
    """float64, world."""
    normal: Annotated[Tensor, "N 3"]
    """float32, unit, towards the views that saw it."""
    edge: Annotated[Tensor, "N"]
    """Edge of the point's voxel, world units, float64."""
    space: Annotated[Tensor, "N"]
    """Mean distance to the nearest neighbours, world units, float64."""
    view: Annotated[Tensor, "N"]
    """int64 index, among the sights, of the view that sees it best."""


def fuse(
    sights: Sights,
    *,
    edge: float | None,
    most: int,
    tolerance: float,
    agree: int,
    report: Callable[[int, int], None] = lambda done, total: None,
    counts: dict[str, int] | None = None,
) -> Cloud:
    """The cloud of V >= 2 views.

    `edge` is the finest voxel's, in world units; None takes the median pixel's. It is doubled until at most `most` points
    are left. Points count as seen by a view that has a surface within `tolerance` of their distance; `agree` other views
    must (fewer where fewer look there, but one at least). `counts` is told the pixels that see a surface (`seen`) and
    those of them that views agree on (`agreed`). Raises DataError where nothing is left.
    """
    found, views = [], []
    for index in range(len(sights.depth)):
        report(index, len(sights.depth))
        seen = _agreed(sights, index, tolerance, agree)
        found.append(seen)
        views.append(torch.full((len(seen.point),), index))
    report(len(sights.depth), len(sights.depth))
    every = Surface(*(torch.cat(column) for column in zip(*found, strict=True)))
    del found, seen  # of many views, the largest thing in memory
    if counts is not None:
        counts["seen"] = sum(int(depth.isfinite().sum()) for depth in sights.depth)
        counts["agreed"] = len(every.point)
    if len(every.point) == 0:
        raise DataError(
            "export: no surface that two views agree on; the scene may be trained too little (see `fprf eval`), "
            "or raise --tolerance"
        )
    base = float(every.footprint.median()) if edge is None else edge
    view = torch.cat(views)
    cloud = _thin(every, view, base)
    while len(cloud.point) > most:
        base *= 2 ** max(0.25, 0.5 * float(torch.log2(torch.tensor(len(cloud.point) / most))))
        cloud = _thin(every, view, base)
    # Last, since it costs more than all before: points that stand alone have no spacing, and go.
    apart = spacing(cloud.point, cloud.edge)
    return Cloud(*(column[apart.isfinite()] for column in cloud._replace(space=apart)))


def joined(first: Cloud, second: Cloud) -> Cloud:
    """Both clouds of the same sights, one after the other."""
    return Cloud(*(torch.cat(pair) for pair in zip(first, second, strict=True)))


def partners(sights: Sights, view: int, points: Annotated[Tensor, "N 3"], tolerance: float) -> list[int]:
    """The other views that see most of a view's points, at most `_PARTNERS`."""
    probe = points[:: max(1, len(points) // _PROBES)]
    shared = []
    for other in range(len(sights.depth)):
        if other == view:
            continue
        gap, distance = gaps(sights, other, probe)
        count = int((gap.abs() <= 2 * tolerance * distance).sum())
        if count:
            shared.append((-count, other))
    return [other for _, other in sorted(shared)[:_PARTNERS]]


def _agreed(sights: Sights, view: int, tolerance: float, agree: int) -> Surface:
    seen = surface(sights, view)
    seen = _some(seen, seen.facing > _GRAZING)
    same, past, looked = (torch.zeros(len(seen.point), dtype=torch.int64) for _ in range(3))
    for other in partners(sights, view, seen.point, tolerance):
        gap, distance = gaps(sights, other, seen.point)
        near = gap.abs() <= tolerance * distance
        through = gap > 2 * tolerance * distance
        same, past, looked = same + near, past + through, looked + (near | through)
    return _some(seen, (same >= looked.clamp(1, max(1, agree))) & (2 * past <= same))


def _some(seen: Surface, which: Tensor) -> Surface:
    return Surface(*(column[which] for column in seen))


def _thin(seen: Surface, view: Tensor, base: float) -> Cloud:
    """One point a voxel: means weighted by how finely each pixel samples the surface. Spacings are left at 0."""
    middle = seen.point.mean(0)
    local = seen.point - middle
    level = torch.log2(seen.footprint.double() / base).round().long().clamp(0, LEVELS - 1)
    edge = base * 2.0**level
    cell = cells(local, edge)
    reach = cell.abs().amax(-1) < SPAN - 2
    local, level, cell, view, edge = local[reach], level[reach], cell[reach], view[reach], edge[reach]
    seen = _some(seen, reach)
    key, group = torch.unique(keys(cell, level), return_inverse=True)
    fineness = seen.facing / seen.footprint.square()
    mean = pooled(group, torch.cat([local, seen.normal.double()], 1), fineness, len(key))
    best = _best(group, fineness, len(key))
    point, normal, level, edge = mean[:, :3], mean[:, 3:], level[best], edge[best]
    # Surfaces seen from both sides share a voxel where they are thin: their mean has no direction.
    keep = (torch.linalg.vector_norm(normal, dim=-1) > 0.5) & finest_alone(point, level, base)
    point, normal, edge, view = point[keep], normal[keep], edge[keep], view[best][keep]
    direction = torch.nn.functional.normalize(normal, dim=-1).float()
    return Cloud(point + middle, direction, edge, torch.zeros_like(edge), view)


def _best(group: Annotated[Tensor, "N"], score: Annotated[Tensor, "N"], groups: int) -> Annotated[Tensor, "groups"]:
    """Index of the member of each group whose score is highest."""
    order = score.argsort(stable=True)
    rank = torch.arange(len(order))
    last = torch.zeros(groups, dtype=torch.int64).scatter_reduce(0, group[order], rank, "amax", include_self=True)
    return order[last]
