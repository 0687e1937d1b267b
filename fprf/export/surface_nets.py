"""The zero surface of a signed distance on a sparse lattice, by surface nets (Gibson 1998): triangles without a table.

Letters: M lattice points with a value, positive outside. A cell is the cube of 8 neighbouring lattice points; one whose
corners have both signs gets a vertex, the mean of the places where its edges cross zero. Each lattice edge that crosses zero
gives a quad of the 4 cells round it, if all of them are there.
"""

from typing import Annotated

import torch
from torch import Tensor

from .voxels import keys

__all__ = ["surface_nets"]

_CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
_CHUNK = 1 << 20
"""Cells at a time: few of them have a vertex, and all of their corners at once would take most of the memory."""
_EDGES = [(a, b) for a in range(8) for b in range(a) if bin(a ^ b).count("1") == 1]


def surface_nets(
    cell: Annotated[Tensor, "M 3"], value: Annotated[Tensor, "M"]
) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "F 3"]]:
    """Vertices in lattice coordinates (float64) and triangles (int64), counter-clockwise seen from outside.

    Lattice points are integers within `voxels.SPAN`, each at most once. What borders on a point without a value is open.
    """
    key, order = keys(cell).sort()
    cell, value = cell[order], value[order].double()
    inside = value < 0
    mixed = torch.cat([_mixed(key, inside, part) for part in torch.split(cell, _CHUNK)])
    vertex = torch.full((len(cell),), -1, dtype=torch.int64)
    vertex[mixed] = torch.arange(int(mixed.sum()))
    at = cell[mixed].double() + _crossings(value[_corners(key, cell[mixed])])
    faces = [_quads(cell, key, inside, vertex, at, axis) for axis in range(3)]
    return at, torch.cat(faces)


def _corners(key: Annotated[Tensor, "M"], cell: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 8"]:
    """Where in the sorted keys the 8 lattice points of each cell are; -1 = not there."""
    return torch.stack([_find(key, keys(cell + torch.tensor(shift))) for shift in _CORNERS], 1)


def _mixed(
    key: Annotated[Tensor, "M"], inside: Annotated[Tensor, "M"], cell: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N"]:
    """Which cells have all corners, and both signs among them."""
    corner = _corners(key, cell)
    signs = inside[corner.clamp_min(0)]
    return (corner >= 0).all(1) & signs.any(1) & ~signs.all(1)


def _find(key: Annotated[Tensor, "M"], wanted: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """Where in the sorted keys the wanted ones are; -1 = not there."""
    if len(key) == 0:
        return torch.full_like(wanted, -1)
    index = torch.searchsorted(key, wanted).clamp(max=len(key) - 1)
    return torch.where(key[index] == wanted, index, -1)


def _crossings(value: Annotated[Tensor, "N 8"]) -> Annotated[Tensor, "N 3"]:
    """Mean of the zero crossings on a cell's 12 edges, from its lowest corner."""
    place = torch.tensor(_CORNERS, dtype=value.dtype)
    total, count = value.new_zeros(len(value), 3), value.new_zeros(len(value), 1)
    for a, b in _EDGES:
        crosses = ((value[:, a] < 0) != (value[:, b] < 0))[:, None]
        part = (value[:, a] / torch.where(crosses[:, 0], value[:, a] - value[:, b], 1.0))[:, None]
        total += torch.where(crosses, place[a] + part * (place[b] - place[a]), 0.0)
        count += crosses
    return total / count.clamp_min(1)


def _quads(cell: Tensor, key: Tensor, inside: Tensor, vertex: Tensor, at: Tensor, axis: int) -> Annotated[Tensor, "F 3"]:
    """Two triangles for each lattice edge along an axis that crosses zero, split along the shorter diagonal."""
    step = torch.zeros(3, dtype=torch.int64)
    step[axis] = 1
    b, c = step.roll(1), step.roll(2)
    ahead = _find(key, keys(cell + step))
    crosses = (ahead >= 0) & (inside != inside[ahead.clamp_min(0)])
    here = cell[crosses]
    round_it = torch.stack([_find(key, keys(here - shift)) for shift in (b + c, c, torch.zeros_like(b), b)], 1)
    corner = torch.where(round_it >= 0, vertex[round_it.clamp_min(0)], -1)
    whole = (corner >= 0).all(1)
    corner, outwards = corner[whole], inside[crosses][whole]
    # Round the edge the four cells run counter-clockwise seen from its far end, which is outside if its start is inside.
    corner = torch.where(outwards[:, None], corner, corner.flip(1))
    place = at[corner]
    first = torch.linalg.vector_norm(place[:, 0] - place[:, 2], dim=-1)
    second = torch.linalg.vector_norm(place[:, 1] - place[:, 3], dim=-1)
    corner = torch.where((first <= second)[:, None], corner, corner.roll(-1, 1))
    return torch.cat([corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]])
