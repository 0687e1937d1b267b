"""Triangles of a scene's near surfaces: depth maps to a truncated signed distance, to surface nets, without small loose pieces.

Signed distance (Curless and Levoy 1996), on a sparse lattice, positive towards the cameras: a lattice point's gap along the
ray times the cosine at which the ray meets the surface, averaged over views. Only the surroundings of points that views
agree on have lattice points.

Surface nets (Gibson 1998), letters: M lattice points with a value. A cell is the cube of 8 neighbouring lattice points; one
whose corners have both signs gets a vertex, the mean of the places where its edges cross zero. Each lattice edge that crosses
zero gives a quad of the 4 cells round it, if all of them are there.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_bytes
from ..io.images import srgb_to_linear
from ..rendering.local_frame import added_and_beside, write_offset
from ..splats.files.ply import ply_file
from ..types import Origin
from .depth_maps import DepthMaps, at_nearest, cosine_map, depth_gaps
from .point_cloud import SPAN, Cloud, cells, keys, vertex_table

_TRUNCATION = 3.0
"""Distances are cut at so many edges."""
_BLOCK = 4
"""Lattice points come in cubes of so many a side: those that hold a point of the cloud, and their neighbours."""
_STEEP = 0.1
"""Smallest cosine that distances are multiplied with: below, a depth map knows little of the surface's place."""
_CLEAR = 0.3
"""Weight of a view that looks past a lattice point, against one that sees a surface there head-on."""
_CHUNK = 1 << 18


class SignedDistance(NamedTuple):
    """M points of a lattice, and how far they are outside of the surface."""

    cell: Annotated[Tensor, "M 3"]
    """int64; the place in the world is origin + edge * cell."""
    value: Annotated[Tensor, "M"]
    """In truncation distances, [-1, 1], float32."""
    origin: Annotated[Tensor, "3"]
    """float64, local."""
    edge: float


def lattice_near(cloud: Cloud, edge: float, most: int) -> tuple[Annotated[Tensor, "M 3"], Annotated[Tensor, "3"], float]:
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
    maps: DepthMaps,
    cell: Annotated[Tensor, "M 3"],
    origin: Annotated[Tensor, "3"],
    edge: float,
    report: Callable[[int, int], None] = lambda done, total: None,
) -> SignedDistance:
    """The signed distance at lattice points that two views or more say something of."""
    far = _TRUNCATION * edge
    total, weight = torch.zeros(len(cell)), torch.zeros(len(cell))
    count = torch.zeros(len(cell), dtype=torch.int16)
    for view in range(len(maps.depth)):
        report(view, len(maps.depth))
        cosine = cosine_map(maps, view)
        for part in torch.split(torch.arange(len(cell)), _CHUNK):
            point = origin + edge * cell[part].double()
            gap, distance = depth_gaps(maps, view, point)
            close = gap.abs() < far / _STEEP
            slope = torch.full_like(gap, _CLEAR)
            slope[close] = at_nearest(maps, view, cosine, point[close]).clamp_min(_STEEP)
            value = (gap * slope / far).clamp(max=1)
            # Far in front nobody asks how the surface behind lies.
            value = torch.where(close, value, torch.where(gap > 0, 1.0, torch.nan))
            seen = value >= -1
            here, one = part[seen], (slope / distance.square())[seen].float()
            total[here] += one * value[seen].float()
            weight[here] += one
            count[here] += 1
    report(len(maps.depth), len(maps.depth))
    known = count >= 2
    return SignedDistance(cell[known], total[known] / weight[known], origin, edge)


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
    """Index in the sorted keys of the 8 lattice points of each cell; -1 = absent."""
    return torch.stack([_find(key, keys(cell + torch.tensor(shift))) for shift in _CORNERS], 1)


def _mixed(
    key: Annotated[Tensor, "M"], inside: Annotated[Tensor, "M"], cell: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N"]:
    """Mask of the cells with all corners, and both signs among them."""
    corner = _corners(key, cell)
    signs = inside[corner.clamp_min(0)]
    return (corner >= 0).all(1) & signs.any(1) & ~signs.all(1)


def _find(key: Annotated[Tensor, "M"], wanted: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """Index in the sorted keys of the wanted ones; -1 = absent."""
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
    """float64, local."""
    face: Annotated[Tensor, "F 3"]
    """int64."""
    normal: Annotated[Tensor, "N 3"]
    """float32, unit."""
    edge: float
    """Of the lattice, world units."""


def build_mesh(
    maps: DepthMaps, cloud: Cloud, *, edge: float | None = None, report: Callable[[int, int], None] = lambda done, total: None
) -> Mesh:
    """The mesh of a cloud's near surfaces. Raises DataError where no surface comes out."""
    finest = float(cloud.edge.amin())
    near = Cloud(*(column[cloud.edge <= _NEAR * finest] for column in cloud))
    cell, origin, width = lattice_near(near, _FINE * finest if edge is None else edge, _MOST)
    lattice = integrate(maps, cell, origin, width, report)
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


def write_mesh_ply(path: Path, mesh: Mesh, colour: Annotated[Tensor, "N 3"], origin: Origin, *, local: bool = False) -> None:
    """Write the mesh as PLY, in the world or `local`, with 8-bit sRGB colours."""
    faces = np.empty(len(mesh.face), [("vertex_indices", [("count", "u1"), ("corners", "<i4", 3)])])
    faces["vertex_indices"]["count"], faces["vertex_indices"]["corners"] = 3, mesh.face.numpy()
    added, beside = added_and_beside(origin, local)
    write_bytes(path, ply_file({"vertex": vertex_table(mesh.point, mesh.normal, colour, added), "face": faces}))
    write_offset(path, beside)


def write_mesh_glb(path: Path, mesh: Mesh, colour: Annotated[Tensor, "N 3"], origin: Origin, *, local: bool = False) -> None:
    """Write the mesh as binary glTF, shown as it is: unlit, with 16-bit linear colours, which glTF asks for.

    Vertices are local, since glTF has float32; its node's translation, or where `local` a file beside, is the origin.
    """
    import trimesh

    shade = np.ones((len(mesh.point), 4))
    shade[:, :3] = srgb_to_linear(np.clip(colour.double().numpy(), 0, 1))
    body = trimesh.Trimesh(
        mesh.point.float().numpy(),
        mesh.face.numpy(),
        vertex_normals=mesh.normal.numpy(),
        # trimesh rounds colours to 8 bits, which band in the dark where they are linear: they go in as an attribute.
        vertex_attributes={"_COLOR_0": np.rint(shade * 65535).astype("<u2")},
        process=False,
    )
    added, beside = added_and_beside(origin, local)

    def processed(tree: dict[str, Any]) -> None:
        _unlit(tree)
        for node in tree["nodes"]:
            if "mesh" in node and any(added):
                node["translation"] = list(added)

    data = body.export(file_type="glb", include_normals=True, unitize_normals=False, tree_postprocessor=processed)
    assert isinstance(data, bytes)
    write_bytes(path, data)
    write_offset(path, beside)


def _unlit(tree: dict[str, Any]) -> None:
    """Make the attribute of colours the vertices' colours, and the material unlit, in a glTF document."""
    [primitive] = tree["meshes"][0]["primitives"]
    primitive["attributes"]["COLOR_0"] = colours = primitive["attributes"].pop("_COLOR_0")
    tree["accessors"][colours]["normalized"] = True
    primitive["material"], rough = 0, {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    material = {"doubleSided": True, "pbrMetallicRoughness": rough, "extensions": {"KHR_materials_unlit": {}}}
    tree["materials"], tree["extensionsUsed"] = [material], ["KHR_materials_unlit"]
