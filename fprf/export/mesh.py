"""Triangles of a scene's near surfaces: depth maps to a truncated signed distance, to surface nets, without small loose pieces.

Signed distance (Curless and Levoy 1996), on a sparse lattice, positive towards the cameras: a lattice point's gap along the
ray times the cosine at which the ray meets the surface, averaged over views. Only the surroundings of points that views
agree on have lattice points.

Surface nets (Gibson 1998), letters: M lattice points with a value. A cell is the cube of 8 neighbouring lattice points; one
whose corners have both signs gets a vertex, the mean of the places where its edges cross zero. Each lattice edge that crosses
zero gives a quad of the 4 cells round it, if all of them are there.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_bytes
from ..rendering.cameras import project
from .depth_maps import Sights, facing_map, gaps
from .point_cloud import SPAN, Cloud, cells, columns, keys, told, write_ply

__all__ = [
    "Lattice",
    "Mesh",
    "around",
    "build_mesh",
    "components",
    "integrate",
    "linear",
    "surface_nets",
    "vertex_normals",
    "write_glb",
    "write_mesh_glb",
    "write_mesh_ply",
]


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


_CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
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


_ARRAY, _ELEMENTS = 34962, 34963
_UINT16, _UINT32, _FLOAT = 5123, 5125, 5126


def write_glb(
    path: Path, point: NDArray[np.float32], normal: NDArray[np.float32], face: NDArray[np.uint32], colour: NDArray[np.float32]
) -> None:
    """Vertices [N 3], normals [N 3], triangles [F 3], sRGB colours [N 3] in [0, 1]; whole or not at all.

    Every viewer multiplies COLOR_0 as linear light: 8 bits of that would band in the dark.
    """
    shade = np.ones((len(colour), 4))
    shade[:, :3] = linear(colour)
    blocks = [
        point.astype("<f4"),
        normal.astype("<f4"),
        np.rint(shade * 65535).astype("<u2"),
        face.astype("<u4").reshape(-1),
    ]
    views, start = [], 0
    for block, target in zip(blocks, (_ARRAY, _ARRAY, _ARRAY, _ELEMENTS), strict=True):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": block.nbytes, "target": target})
        start += block.nbytes
    count = len(point)
    document = {
        "asset": {"version": "2.0", "generator": "fprf"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "materials": [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": count,
                "type": "VEC3",
                "min": blocks[0].min(0).tolist(),
                "max": blocks[0].max(0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": count, "type": "VEC3"},
            {"bufferView": 2, "componentType": _UINT16, "normalized": True, "count": count, "type": "VEC4"},
            {"bufferView": 3, "componentType": _UINT32, "count": face.size, "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    head = json.dumps(document, separators=(",", ":")).encode("ascii")
    head += b" " * (-len(head) % 4)
    body = b"".join(block.tobytes() for block in blocks)
    total = 12 + 8 + len(head) + 8 + len(body)
    parts = [struct.pack("<4sII", b"glTF", 2, total), struct.pack("<I4s", len(head), b"JSON"), head]
    write_bytes(path, b"".join([*parts, struct.pack("<I4s", len(body), b"BIN\0"), body]))


def linear(colour: NDArray[np.floating]) -> NDArray[np.float64]:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    c = np.clip(colour.astype(np.float64), 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


_NEAR = 4.0
"""Points of voxels more than so many times the finest stay out: far surfaces are known too coarsely for a mesh."""
_FINE = 2.0
"""Edge of the lattice, in edges of the finest voxel, unless the user says otherwise."""
_MOST = 8_000_000
"""Lattice points, at most."""
_LOOSE = 2e-3
"""Pieces with a smaller share of all triangles are dropped."""


class Mesh(NamedTuple):
    """N vertices and F triangles, counter-clockwise seen from outside."""

    point: Annotated[Tensor, "N 3"]
    """float64, world."""
    face: Annotated[Tensor, "F 3"]
    """int64."""
    normal: Annotated[Tensor, "N 3"]
    """float32, unit."""
    edge: float
    """Of the lattice, world units."""


def build_mesh(
    sights: Sights, cloud: Cloud, *, edge: float | None = None, report: Callable[[int, int], None] = lambda done, total: None
) -> Mesh:
    """The mesh of a cloud's near surfaces. Raises DataError where no surface comes out."""
    finest = float(cloud.edge.amin())
    near = Cloud(*(column[cloud.edge <= _NEAR * finest] for column in cloud))
    cell, origin, width = around(near, _FINE * finest if edge is None else edge, _MOST)
    lattice = integrate(sights, cell, origin, width, report)
    at, face = surface_nets(lattice.cell, lattice.value)
    piece = components(len(at), face)
    size = torch.bincount(piece[face[:, 0]], minlength=len(at))
    face = face[size[piece[face[:, 0]]] >= max(8, _LOOSE * len(face))]
    if len(face) == 0:
        raise DataError("export: no surface for a mesh; raise --mesh-edge, or export ply or splat instead")
    used, corner = torch.unique(face, return_inverse=True)
    point, face = origin + width * at[used], corner.view(-1, 3)
    return Mesh(point, face, vertex_normals(point - origin, face), width)


def components(count: int, face: Annotated[Tensor, "F 3"]) -> Annotated[Tensor, "count"]:
    """For each vertex the smallest index of those that it is connected with."""
    label = torch.arange(count)
    pair = torch.cat([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]])
    while True:
        least = torch.minimum(label[pair[:, 0]], label[pair[:, 1]])
        new = label.clone()
        for side in (0, 1):
            # The label of a label moves too: a long piece is labelled in a logarithm of its length.
            new.scatter_reduce_(0, label[pair[:, side]], least, "amin")
            new.scatter_reduce_(0, pair[:, side], least, "amin")
        new = new[new]
        if torch.equal(new, label):
            return label
        label = new


def vertex_normals(point: Annotated[Tensor, "N 3"], face: Annotated[Tensor, "F 3"]) -> Annotated[Tensor, "N 3"]:
    """Sums of the triangles' normals, weighted by area; float32, unit."""
    a, b, c = (point[face[:, k]] for k in range(3))
    normal = torch.linalg.cross(b - a, c - a)
    total = torch.zeros_like(point)
    for k in range(3):
        total.index_add_(0, face[:, k], normal)
    return torch.nn.functional.normalize(total, dim=-1).float()


def write_mesh_ply(path: Path, mesh: Mesh, colour: Annotated[Tensor, "N 3"], origin: Annotated[Tensor, "3"]) -> None:
    """The mesh as PLY, 8-bit sRGB colours."""
    table = columns(mesh.point - origin, mesh.normal, colour)
    write_ply(path, table, mesh.face.numpy().astype(np.int32), comments=told(origin))


def write_mesh_glb(path: Path, mesh: Mesh, colour: Annotated[Tensor, "N 3"], origin: Annotated[Tensor, "3"]) -> None:
    """The mesh as binary glTF."""
    point, face = (mesh.point - origin).float().numpy(), mesh.face.numpy().astype(np.uint32)
    write_glb(path, point, mesh.normal.numpy(), face, colour.float().numpy())
