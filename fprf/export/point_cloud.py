"""Fuse depth maps into one point cloud: checked against other views, one point a voxel, with normals and a dome of sky.

A pixel's point stays where other views that look there see a surface at the same distance, and few look through it. Voxels
are as wide as the pixels that hit them, in powers of two (edges `base * 2**level`): what is near is fine, what is far is
coarse. Keys are one int64 a voxel: 5 bits of level and 19 bits an axis, so a scene may span 524,288 voxels of its finest level.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_bytes
from ..rendering.cameras import pixel_grid, rays_through
from ..rendering.local_frame import added_and_beside, write_offset
from ..splats.files.ply import in_world, ply_file
from ..types import Origin
from .depth_maps import DepthMaps, Surface, depth_gaps, surface_points

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


def finest_only(points: Annotated[Tensor, "N 3"], level: Annotated[Tensor, "N"], base: float) -> Annotated[Tensor, "N"]:
    """True for points whose voxel holds no point of a finer level: one surface is not covered twice."""
    alone = torch.ones(len(points), dtype=torch.bool)
    for coarse in sorted(set(level.tolist()))[1:]:
        edge = base * 2**coarse
        finer, here = level < coarse, level == coarse
        covered = torch.isin(keys(cells(points[here], edge)), keys(cells(points[finer], edge)))
        alone[here.nonzero()[:, 0][covered]] = False
    return alone


def spacing(points: Annotated[Tensor, "N 3"], edge: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """Mean distance of each point to its 4 nearest neighbours; infinite where it has fewer within two edges of its own."""
    result = torch.full((len(points),), torch.inf, dtype=points.dtype)
    shifts = torch.cartesian_prod(*(torch.arange(-1, 2),) * 3)
    for width in sorted(set(edge.tolist())):
        cell = cells(points, 2 * width)
        sorted_keys, order = keys(cell).sort()
        for mine in (edge == width).nonzero()[:, 0].split(_CHUNK):
            around = keys(cell[mine, None] + shifts)
            index = torch.searchsorted(sorted_keys, around)[:, :, None] + torch.arange(_CROWD)
            known = index < len(points)
            index = index.clamp(max=len(points) - 1)
            there = order[index]
            wanted = known & (around[:, :, None] == sorted_keys[index]) & (there != mine[:, None, None])
            away = torch.linalg.vector_norm(points[there] - points[mine, None, None], dim=-1)
            away = torch.where(wanted & (away <= 2 * width), away, torch.inf).view(len(mine), -1)
            result[mine] = away.topk(4, largest=False).values.mean(-1)
    return result


_GRAZING = 0.04
"""Pixels that see their surface at a smaller cosine are left out: their depth is as uncertain as it is long."""
_PARTNERS = 8
"""Other views that a view is checked against."""
_PROBES = 256
"""Points of a view by which its partners are found."""


class Cloud(NamedTuple):
    """N points of a scene's surfaces."""

    point: Annotated[Tensor, "N 3"]
    """float64, local."""
    normal: Annotated[Tensor, "N 3"]
    """float32, unit, towards the views that saw it."""
    edge: Annotated[Tensor, "N"]
    """Edge of the point's voxel, world units, float64."""
    space: Annotated[Tensor, "N"]
    """Mean distance to the nearest neighbours, world units, float64."""
    view: Annotated[Tensor, "N"]
    """int64 index, among the maps, of the view that sees it best."""


def fuse(
    maps: DepthMaps,
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
    for index in range(len(maps.depth)):
        report(index, len(maps.depth))
        seen = _consistent(maps, index, tolerance, agree)
        found.append(seen)
        views.append(torch.full((len(seen.point),), index))
    report(len(maps.depth), len(maps.depth))
    every = Surface(*(torch.cat(column) for column in zip(*found, strict=True)))
    del found, seen  # of many views, the largest thing in memory
    if counts is not None:
        counts["seen"] = sum(int(depth.isfinite().sum()) for depth in maps.depth)
        counts["agreed"] = len(every.point)
    if len(every.point) == 0:
        raise DataError(
            "export: no surface that two views agree on; the scene may be trained too little (see `fprf eval`), "
            "or raise --tolerance"
        )
    base = float(every.footprint.median()) if edge is None else edge
    view = torch.cat(views)
    cloud = _one_per_voxel(every, view, base)
    while len(cloud.point) > most:
        base *= 2 ** max(0.25, 0.5 * float(torch.log2(torch.tensor(len(cloud.point) / most))))
        cloud = _one_per_voxel(every, view, base)
    # Last, since it costs more than all before: points that stand alone have no spacing, and go.
    apart = spacing(cloud.point, cloud.edge)
    return Cloud(*(column[apart.isfinite()] for column in cloud._replace(space=apart)))


def concatenate(first: Cloud, second: Cloud) -> Cloud:
    """Both clouds of the same maps, one after the other."""
    return Cloud(*(torch.cat(pair) for pair in zip(first, second, strict=True)))


def overlapping_views(maps: DepthMaps, view: int, points: Annotated[Tensor, "N 3"], tolerance: float) -> list[int]:
    """The other views that see most of a view's points, at most `_PARTNERS`."""
    probe = points[:: max(1, len(points) // _PROBES)]
    shared = []
    for other in range(len(maps.depth)):
        if other == view:
            continue
        gap, distance = depth_gaps(maps, other, probe)
        count = int((gap.abs() <= 2 * tolerance * distance).sum())
        if count:
            shared.append((-count, other))
    return [other for _, other in sorted(shared)[:_PARTNERS]]


def _consistent(maps: DepthMaps, view: int, tolerance: float, agree: int) -> Surface:
    seen = surface_points(maps, view)
    seen = _select(seen, seen.facing > _GRAZING)
    same, past, looked = (torch.zeros(len(seen.point), dtype=torch.int64) for _ in range(3))
    for other in overlapping_views(maps, view, seen.point, tolerance):
        gap, distance = depth_gaps(maps, other, seen.point)
        near = gap.abs() <= tolerance * distance
        through = gap > 2 * tolerance * distance
        same, past, looked = same + near, past + through, looked + (near | through)
    return _select(seen, (same >= looked.clamp(1, max(1, agree))) & (2 * past <= same))


def _select(seen: Surface, which: Tensor) -> Surface:
    return Surface(*(column[which] for column in seen))


def _one_per_voxel(seen: Surface, view: Tensor, base: float) -> Cloud:
    """One point a voxel: means weighted by how finely each pixel samples the surface. Spacings are left at 0."""
    middle = seen.point.mean(0)
    local = seen.point - middle
    level = torch.log2(seen.footprint.double() / base).round().long().clamp(0, LEVELS - 1)
    edge = base * 2.0**level
    cell = cells(local, edge)
    reach = cell.abs().amax(-1) < SPAN - 2
    local, level, cell, view, edge = local[reach], level[reach], cell[reach], view[reach], edge[reach]
    seen = _select(seen, reach)
    key, group = torch.unique(keys(cell, level), return_inverse=True)
    fineness = seen.facing / seen.footprint.square()
    mean = pooled(group, torch.cat([local, seen.normal.double()], 1), fineness, len(key))
    best = _best(group, fineness, len(key))
    point, normal, level, edge = mean[:, :3], mean[:, 3:], level[best], edge[best]
    # Surfaces seen from both sides share a voxel where they are thin: their mean has no direction.
    keep = (torch.linalg.vector_norm(normal, dim=-1) > 0.5) & finest_only(point, level, base)
    point, normal, edge, view = point[keep], normal[keep], edge[keep], view[best][keep]
    direction = torch.nn.functional.normalize(normal, dim=-1).float()
    return Cloud(point + middle, direction, edge, torch.zeros_like(edge), view)


def _best(group: Annotated[Tensor, "N"], score: Annotated[Tensor, "N"], groups: int) -> Annotated[Tensor, "groups"]:
    """Index of the member of each group whose score is highest."""
    order = score.argsort(stable=True)
    rank = torch.arange(len(order))
    last = torch.zeros(groups, dtype=torch.int64).scatter_reduce(0, group[order], rank, "amax", include_self=True)
    return order[last]


_COARSE = 2.0
"""Edge of a dome's cell, in pixels: what is far is smooth."""
_LOOSE = 1.5
"""Distance of neighbours, in cells: a cubic lattice cuts a sphere unevenly, and a gap in the sky is black."""
_FAR = 3.0
"""Radius of the dome, in distances of the outermost of the scene's points."""


def sky_dome(maps: DepthMaps, cloud: Cloud) -> Cloud | None:
    """Points in the directions in which views see nothing within reach, facing inwards; None where all see something."""
    cameras = maps.cameras
    directions, views = [], []
    for index, depth in enumerate(maps.depth):
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
    radius = _FAR * float(torch.linalg.vector_norm(cloud.point - centre, dim=-1).amax())
    return Cloud(centre + radius * mean, -mean.float(), radius * width, _LOOSE * radius * width, view[first])


def write_points(path: Path, cloud: Cloud, colour: Annotated[Tensor, "N 3"], origin: Origin, *, local: bool = False) -> None:
    """Write the coloured cloud with normals as PLY, in the world or `local`."""
    added, beside = added_and_beside(origin, local)
    write_bytes(path, ply_file({"vertex": vertex_table(cloud.point, cloud.normal, colour, added)}))
    write_offset(path, beside)


def vertex_table(
    point: Annotated[Tensor, "N 3"],
    normal: Annotated[Tensor, "N 3"],
    colour: Annotated[Tensor, "N 3"],
    origin: Origin = (0.0, 0.0, 0.0),
) -> NDArray[np.void]:
    """Vertices of a PLY: float x y z nx ny nz, uchar red green blue, rounded as pictures are.

    Where the origin is not 0, x y z are double, of the world.
    """
    table = np.empty(len(point), [("real", "<f4", 6), ("shade", "u1", 3)])
    table["real"] = torch.cat([point, normal.to(point)], 1).float().numpy()
    table["shade"] = (colour.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    named = [*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), *((c, "u1") for c in ("red", "green", "blue"))]
    return in_world(table.view(named), point.numpy(), origin)
