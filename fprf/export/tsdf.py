"""Depth maps to a truncated signed distance on a sparse lattice (Curless and Levoy 1996), positive towards the cameras.

The distance of a lattice point from a view's surface is its gap along the ray times the cosine at which the ray meets the
surface; views are averaged. Only the surroundings of points that views agree on have lattice points.
"""

from collections.abc import Callable
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..rendering.cameras import project
from .fusion import Cloud
from .sights import Sights, facing_map, gaps
from .voxels import SPAN, cells

__all__ = ["Lattice", "around", "integrate"]

_TRUNCATION = 3.0
"""Distances are cut at so many edges."""
_BLOCK = 4
"""Lattice points come in cubes of so many a side: those that hold a point of the cloud, and their neighbours."""
_STEEP = 0.1
"""Smallest cosine that distances are multiplied with: below, a depth map knows little of the surface's place."""
_CLEAR = 0.3
"""How much a view that looks past a lattice point counts, against one that sees a surface there head-on."""
_CHUNK = 1 << 18


class Lattice(NamedTuple):
    """M points of a lattice, and how far they are outside of the surface."""

    cell: Annotated[Tensor, "M 3"]
    """int64; the place in the world is origin + edge * cell."""
    value: Annotated[Tensor, "M"]
    """In truncation distances, [-1, 1], float32."""
    origin: Annotated[Tensor, "3"]
    """float64, world."""
    edge: float


def around(cloud: Cloud, edge: float, most: int) -> tuple[Annotated[Tensor, "M 3"], Annotated[Tensor, "3"], float]:
    """Lattice points near a cloud, the lattice's origin, and its edge: doubled until there are at most `most` points."""
    origin = cloud.point.mean(0)
    while True:
        block = torch.unique(cells(cloud.point - origin, edge * _BLOCK), dim=0)
        shifts = torch.cartesian_prod(*(torch.arange(-1, 2),) * 3)
        block = torch.unique((block[:, None] + shifts).view(-1, 3), dim=0)
        if len(block) * _BLOCK**3 <= most:
            break
        edge *= 2
    inner = torch.cartesian_prod(*(torch.arange(_BLOCK),) * 3)
    cell = (block[:, None] * _BLOCK + inner).view(-1, 3)
    return cell[cell.abs().amax(1) < SPAN - 2], origin, edge


def integrate(
    sights: Sights,
    cell: Annotated[Tensor, "M 3"],
    origin: Annotated[Tensor, "3"],
    edge: float,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> Lattice:
    """The signed distance at lattice points that two views or more say something of."""
    far = _TRUNCATION * edge
    total, weight = torch.zeros(len(cell)), torch.zeros(len(cell))
    count = torch.zeros(len(cell), dtype=torch.int16)
    for view in range(len(sights.depth)):
        report(view, len(sights.depth))
        cosine = facing_map(sights, view)
        for part in torch.split(torch.arange(len(cell)), _CHUNK):
            point = origin + edge * cell[part].double()
            gap, distance = gaps(sights, view, point)
            close = gap.abs() < far / _STEEP
            slope = torch.full_like(gap, _CLEAR)
            slope[close] = _slopes(sights, view, cosine, point[close])
            value = (gap * slope / far).clamp(max=1)
            # Far in front nobody asks how the surface behind lies.
            value = torch.where(close, value, torch.where(gap > 0, 1.0, torch.nan))
            seen = value >= -1
            here, one = part[seen], (slope / distance.square())[seen].float()
            total[here] += one * value[seen].float()
            weight[here] += one
            count[here] += 1
    report(len(sights.depth), len(sights.depth))
    known = count >= 2
    return Lattice(cell[known], total[known] / weight[known], origin, edge)


def _slopes(sights: Sights, view: int, cosine: Annotated[Tensor, "H W"], point: Annotated[Tensor, "N 3"]) -> Tensor:
    """The cosine at the pixel of each point, at least `_STEEP`."""
    pixel, _ = project(sights.cameras, torch.full((len(point),), view), point)
    height, width = cosine.shape
    x, y = pixel[:, 0].long().clamp(0, width - 1), pixel[:, 1].long().clamp(0, height - 1)
    return cosine[y, x].clamp_min(_STEEP)
