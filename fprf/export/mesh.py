"""Triangles of a scene's near surfaces: from depth maps through a signed distance, without small loose pieces."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import DataError
from .fusion import Cloud
from .glb import write_glb
from .ply import write_ply
from .points import columns, told
from .sights import Sights
from .surface_nets import surface_nets
from .tsdf import around, integrate

__all__ = ["Mesh", "build_mesh", "components", "vertex_normals", "write_mesh_glb", "write_mesh_ply"]

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
