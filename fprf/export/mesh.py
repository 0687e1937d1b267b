"""Triangles of a scene's near surfaces: renders of its views, fused to a truncated signed distance, whose
zero is meshed.

Signed distance (Curless and Levoy 1996), on a sparse lattice, positive towards the cameras: of a lattice
point the depth that a view has at its pixel, less its distance, times the cosine at which the ray meets the
surface; averaged over views.

Surface nets (Gibson 1998): a cell is the cube of 8 neighbouring lattice points; one whose corners have both
signs has a vertex, the mean of the places where its edges cross zero. Each lattice edge that crosses zero
gives a quad of the 4 cells round it, if all of them are there.

Letters: M lattice points, P points, N vertices, F triangles. World axes and units about the run's origin,
float64. Depths are distances along the unit ray through a pixel's centre.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_bytes
from ..io.images import srgb_to_linear
from ..rendering.cameras import Cameras, grid_rays, look_up, normals, project
from ..rendering.local_frame import added_and_beside, write_offset
from ..rendering.space import Space
from ..scenes import Scene
from ..splats.files.base import in_world
from ..splats.files.ply_tables import ply_file
from ..types import Origin

Report = Callable[[int, int], None]

_MIN_SURFACE_OPACITY = 0.5
"""Pixels of a smaller opacity see nothing: more of what they show lies behind. By eye."""
_MAX_DEPTH_RATIO = 1.25
"""Neighbouring pixels whose depths differ by more than this factor lie on different surfaces: far ground
falls away fast. By eye.
"""
_MAX_PIXEL_WIDTHS = 6.0
"""Pixels more than so many times as wide as the median one stay out: far surfaces are known too coarsely for
a mesh. By eye.
"""
_LATTICE_PIXELS = 2.0
"""Edge of the lattice in widths of the median pixel on the surface, unless the user says otherwise:
finer, noise of the depths shows. By eye."""
_CUBE_SIDE = 4
"""Lattice points of a cube, in which they come, along a side: larger ones hold more air. By eye."""
_MARGIN_EDGES = 1.5
"""Edges about what is seen in which there are lattice points: the surface's own cell, and half of the next."""
_MIN_AGREEING_VIEWS = 2
"""Views that must see something in a block, and say something of a lattice point: what
one alone sees is the air before an edge."""
_MAX_LATTICE_POINTS = 8_000_000
"""Lattice points: about 1 GB of memory."""
_MAX_LATTICE_COORDINATE = 1 << 18
"""Lattice points to either side of the origin that keys tell apart: three of 19 bits fit int64."""
_TRUNCATION_EDGES = 3.0
"""Distances are cut at so many edges: beyond, a surface of another side would be met. By eye."""
_MIN_COSINE = 0.1
"""Smallest cosine that distances are multiplied with: below, a depth map knows little of the surface's
place. By eye.
"""
_PASSING_WEIGHT = 0.3
"""Weight of a view that looks past a lattice point, against one that sees a surface there head-on. By eye."""
_MIN_PIECE_SHARE = 2e-3
"""Pieces with a smaller share of all triangles are dropped: they float in the air. By eye."""
_MIN_PIECE_TRIANGLES = 8
"""Pieces with fewer triangles are dropped from any mesh. By eye."""
_POINTS_AT_ONCE = 1 << 18
"""Lattice points that are looked at together: bounds the memory."""


class Maps(NamedTuple):
    """Depth maps and colours of V views."""

    cameras: Cameras
    depth: list[Annotated[Tensor, "H W"]]
    """float32; infinite where nothing solid is within reach."""
    rgb: list[Annotated[Tensor, "H W 3"]]


class Mesh(NamedTuple):
    """N vertices and F triangles, counter-clockwise seen from outside."""

    point: Annotated[Tensor, "N 3"]
    face: Annotated[Tensor, "F 3"]
    """int64."""
    normal: Annotated[Tensor, "N 3"]
    """float32, unit."""
    edge: float
    """Of the lattice, world units."""


def default_reach(space: Space) -> float:
    """Distance up to which surfaces are looked for, in world units: a bounded box is looked at as a whole."""
    if space.kind == "box":
        return math.inf
    if space.kind == "ndc":
        return 50 * space.near
    return 20 / space.scale


def render_maps(scene: Scene, cameras: Cameras, *, side: int, reach: float, report: Report) -> Maps:
    """Render views, reduced to `side` pixels on the longest; what is farther than `reach` is sky."""
    size = cameras.size.double()
    small = cameras.resized(
        (size / (size.amax(1, keepdim=True) / side).clamp_min(1)).round().clamp_min(1).to(cameras.size)
    )
    maps = Maps(small, [], [])
    for view in range(len(small)):
        report(view, len(small))
        shown = scene.render(small, view, resolution=1.0)
        seen = (shown.opacity > _MIN_SURFACE_OPACITY) & (shown.depth > 0) & (shown.depth < reach)
        maps.depth.append(torch.where(seen, shown.depth, torch.inf))
        maps.rgb.append(shown.rgb)
    report(len(small), len(small))
    return maps


def build_mesh(maps: Maps, *, edge: float | None = None, report: Report = lambda done, total: None) -> Mesh:
    """The mesh of near surfaces. Raises DataError where no surface comes out."""
    # Depths of all views become distances on a lattice, and their zero a mesh.
    cell, origin, width = _lattice(maps, edge)
    known, value = _signed_distance(maps, cell, origin, width, report)
    at, face = surface_nets(cell[known], value)
    # Small pieces float in the air, or stand for nothing that anyone looks at.
    piece = _components(len(at), face)
    size = torch.bincount(piece[face[:, 0]], minlength=len(at))
    face = face[size[piece[face[:, 0]]] >= max(_MIN_PIECE_TRIANGLES, _MIN_PIECE_SHARE * len(face))]
    if not len(face):
        raise DataError(
            "export: no surface for a mesh; train longer, raise --mesh-edge, or export ply or splat instead"
        )
    used, corner = torch.unique(face, return_inverse=True)
    point = origin + width * at[used]
    face = corner.view(-1, 3)
    # Normals are sums of the triangles', which the cross product weighs by area.
    a, b, c = (point[face[:, k]] - origin for k in range(3))
    normal = torch.zeros_like(point)
    for k in range(3):
        normal.index_add_(0, face[:, k], torch.linalg.cross(b - a, c - a))
    return Mesh(point, face, F.normalize(normal, dim=-1).float(), width)


def vertex_colours(maps: Maps, mesh: Mesh) -> Annotated[Tensor, "N 3"]:
    """sRGB in [0, 1]: means over the views that see a vertex, those most that have the most pixels on it.

    One view alone would give neighbours the exposures of different pictures. Where no view sees a vertex,
    those count that miss it least.
    """
    # A view's weight: its pixels on the surface there, and steeply less where it sees something else.
    total = torch.zeros(len(mesh.point), 3, dtype=torch.float64)
    share = torch.zeros(len(mesh.point), 1, dtype=torch.float64)
    for view, rgb in enumerate(maps.rgb):
        gap, distance, pixel = _gaps(maps, view, mesh.point)
        towards = (maps.cameras.pose[view, :, 3] - mesh.point) / distance[:, None]
        pixels = (towards * mesh.normal).sum(-1).clamp_min(1e-3) / distance.square()
        missed = (gap.abs() / (2 * mesh.edge)).clamp_min(1).nan_to_num(1e6, 1e6)
        weight = (pixels / missed**6).square()[:, None]
        total += weight * look_up(rgb, pixel.nan_to_num(0.0))
        share += weight
    return (total / share.clamp_min(1e-300)).float().clamp(0, 1)


def _gaps(
    maps: Maps, view: int, point: Annotated[Tensor, "P 3"]
) -> tuple[Tensor, Tensor, Annotated[Tensor, "P 2"]]:
    """Gaps of points before the surface that a view sees there [P], their distances [P], and their pixels.

    Infinite where the view sees nothing, NaN outside of it; negative where something hides the point.
    """
    pixel, _ = project(maps.cameras, torch.full((len(point),), view), point)
    distance = torch.linalg.vector_norm(point - maps.cameras.pose[view, :, 3], dim=-1)
    inside = ((pixel >= 0) & (pixel < maps.cameras.size[view])).all(-1)
    x, y = pixel[inside].long().unbind(-1)
    nearest = maps.depth[view].double()[y, x]
    # 1 / depth of a plane is linear in pixels; where the surface is torn the nearest pixel's depth counts.
    between = 1 / look_up(1 / maps.depth[view].double()[..., None], pixel[inside])[:, 0]
    whole = (between < _MAX_DEPTH_RATIO * nearest) & (nearest < _MAX_DEPTH_RATIO * between)
    gap = torch.full_like(distance, torch.nan)
    gap[inside] = torch.where(whole, between, nearest) - distance[inside]
    return gap, distance, pixel


def _lattice(
    maps: Maps, edge: float | None
) -> tuple[Annotated[Tensor, "M 3"], Annotated[Tensor, "3"], float]:
    """Lattice points near what is seen, the place of (0, 0, 0), and the edge: doubled until they are few
    enough.
    """
    origin = maps.cameras.pose[:, :, 3].mean(0)
    seen = []
    # The lattice is as fine as the pixels on the surface are; what is seen too coarsely stays out.
    parts = []
    for view, depth in enumerate(maps.depth):
        parts.append((depth / maps.cameras.focal[view].mean())[depth.isfinite()])
    width = torch.cat(parts)
    if not len(width):
        raise DataError(
            "export: no view sees a surface within reach; raise --reach, or train longer (see `fprf eval`)"
        )
    finest = float(width.median())
    for view, depth in enumerate(maps.depth):
        centre, direction = grid_rays(maps.cameras, view)
        near = (depth / maps.cameras.focal[view].mean() <= _MAX_PIXEL_WIDTHS * finest).view(-1)
        seen.append((centre + direction * depth.view(-1, 1))[near] - origin)
    edge = _LATTICE_PIXELS * finest if edge is None else edge
    signs = torch.cartesian_prod(*(torch.tensor([-1.0, 1.0], dtype=torch.float64),) * 3)
    while True:
        # A block counts where several views see something in or beside it: what one alone sees is the air
        # before an edge.
        around = _MARGIN_EDGES * edge * signs
        near_view = []
        for points in seen:
            cube = ((points[:, None] + around).view(-1, 3) / (edge * _CUBE_SIDE)).floor().long()
            near_view.append(torch.unique(cube, dim=0))
        block, views = torch.unique(torch.cat(near_view), dim=0, return_counts=True)
        block = block[views >= _MIN_AGREEING_VIEWS]
        if len(block) * _CUBE_SIDE**3 <= _MAX_LATTICE_POINTS:
            break
        edge *= 2
    inner = torch.cartesian_prod(*(torch.arange(_CUBE_SIDE),) * 3)
    cell = (block[:, None] * _CUBE_SIDE + inner).view(-1, 3)
    return cell[cell.abs().amax(1) < _MAX_LATTICE_COORDINATE - 2], origin, edge


def _signed_distance(
    maps: Maps, cell: Annotated[Tensor, "M 3"], origin: Tensor, edge: float, report: Report
) -> tuple[Annotated[Tensor, "M"], Tensor]:
    """Mask of the lattice points that enough views say something of, and their distances, in truncations:
    [-1, 1], float32.
    """
    far = _TRUNCATION_EDGES * edge
    total = torch.zeros(len(cell))
    weight = torch.zeros(len(cell))
    count = torch.zeros(len(cell), dtype=torch.int16)
    for view, depth in enumerate(maps.depth):
        report(view, len(maps.depth))
        facing = (
            -(normals(maps.cameras, view, depth).view(-1, 3) * grid_rays(maps.cameras, view)[1])
            .sum(-1)
            .view(depth.shape)
        )
        for part in torch.split(torch.arange(len(cell)), _POINTS_AT_ONCE):
            gap, distance, pixel = _gaps(maps, view, origin + edge * cell[part].double())
            close = gap.abs() < far / _MIN_COSINE
            slope = torch.full_like(gap, _PASSING_WEIGHT)
            x, y = pixel[close].long().unbind(-1)
            slope[close] = facing[y, x].clamp_min(_MIN_COSINE)
            # Far in front of a surface nobody asks how it lies; behind it the view knows nothing.
            value = torch.where(close, (gap * slope / far).clamp(max=1), torch.where(gap > 0, 1.0, torch.nan))
            seen = value >= -1
            here = part[seen]
            share = (slope / distance.square())[seen].float()
            total[here] += share * value[seen].float()
            weight[here] += share
            count[here] += 1
    report(len(maps.depth), len(maps.depth))
    known = count >= _MIN_AGREEING_VIEWS
    return known, total[known] / weight[known]


_CUBE_CORNERS = torch.cartesian_prod(*(torch.arange(2),) * 3)
"""Corners of a cell, from its lowest one."""


def _edges_of_cube() -> list[tuple[int, int]]:
    """Pairs of corners that differ along one axis."""
    edges = []
    for a in range(8):
        for b in range(a):
            if (a ^ b).bit_count() == 1:
                edges.append((a, b))
    return edges


_CUBE_EDGES = _edges_of_cube()
"""The 12 edges of a cell, by the numbers of their corners."""


def surface_nets(
    cell: Annotated[Tensor, "M 3"], value: Annotated[Tensor, "M"]
) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "F 3"]]:
    """Vertices in lattice coordinates (float64) and triangles (int64), counter-clockwise seen from outside.

    Lattice points are integers within `_MAX_LATTICE_COORDINATE`, each at most once. What borders on a point without a value is
    open.
    """
    if not len(cell):
        return torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.int64)
    key, order = _keys(cell).sort()
    cell = cell[order]
    value = value[order].double()
    inside = value < 0

    def find(wanted: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "..."]:
        """Index of lattice points; -1 = absent."""
        index = torch.searchsorted(key, _keys(wanted)).clamp(max=len(key) - 1)
        return torch.where(key[index] == _keys(wanted), index, -1)

    def mixed(part: Annotated[Tensor, "P 3"]) -> Annotated[Tensor, "P"]:
        """Cells with all corners, and both signs among them."""
        corner = find(part[:, None] + _CUBE_CORNERS)
        signs = inside[corner.clamp_min(0)]
        return (corner >= 0).all(1) & signs.any(1) & ~signs.all(1)

    # A vertex for each such cell: the mean of the zero crossings on its edges, from its lowest corner.
    crossed = torch.cat([mixed(part) for part in torch.split(cell, _POINTS_AT_ONCE)])
    vertex = torch.full((len(cell),), -1)
    vertex[crossed] = torch.arange(int(crossed.sum()))
    corner = value[find(cell[crossed][:, None] + _CUBE_CORNERS)]
    # On each of the 12 edges of a cell the zero lies where the values say, if their signs differ.
    (first, second) = torch.tensor(_CUBE_EDGES).T
    place = _CUBE_CORNERS.double()
    crosses = (corner[:, first] < 0) != (corner[:, second] < 0)
    part = corner[:, first] / torch.where(crosses, corner[:, first] - corner[:, second], 1.0)
    along = place[first] + part[..., None] * (place[second] - place[first])
    mean = (along * crosses[..., None]).sum(1) / crosses.sum(1, keepdim=True)
    at = cell[crossed].double() + mean
    # Two triangles for each lattice edge that crosses zero, split along the shorter diagonal; one axis after
    # the other.
    faces = []
    for step in torch.eye(3, dtype=torch.int64):
        b = step.roll(1)
        c = step.roll(2)
        ahead = find(cell + step)
        crosses = (ahead >= 0) & (inside != inside[ahead.clamp_min(0)])
        around = find(cell[crosses][:, None] - torch.stack([b + c, c, torch.zeros_like(b), b]))
        corner = torch.where(around >= 0, vertex[around.clamp_min(0)], -1)
        whole = (corner >= 0).all(1)
        corner = corner[whole]
        outwards = inside[crosses][whole]
        # Round the edge the four cells run counter-clockwise seen from its far end, which is outside if its
        # start is inside.
        corner = torch.where(outwards[:, None], corner, corner.flip(1))
        one = (at[corner[:, 0]] - at[corner[:, 0 + 2]]).norm(dim=-1)
        other = (at[corner[:, 1]] - at[corner[:, 1 + 2]]).norm(dim=-1)
        corner = torch.where((one <= other)[:, None], corner, corner.roll(-1, 1))
        faces += [corner[:, [0, 1, 2]], corner[:, [0, 2, 3]]]
    return at, torch.cat(faces)


def _keys(cell: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "..."]:
    """One integer a lattice point; coordinates must lie within `_MAX_LATTICE_COORDINATE`."""
    x, y, z = (cell + _MAX_LATTICE_COORDINATE).unbind(-1)
    return (x * 2 * _MAX_LATTICE_COORDINATE + y) * 2 * _MAX_LATTICE_COORDINATE + z


def _components(count: int, face: Annotated[Tensor, "F 3"]) -> Annotated[Tensor, "count"]:
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


def write_mesh(
    path: Path, mesh: Mesh, colour: Annotated[Tensor, "N 3"], origin: Origin, *, local: bool = False
) -> None:
    """Write a .ply, in the world or `local`, with 8-bit sRGB colours, or a .glb (see `_glb`)."""
    added, beside = added_and_beside(origin, local)
    if path.suffix.lower() == ".glb":
        write_bytes(path, _glb(mesh, colour, added))
    else:
        faces = np.empty(len(mesh.face), [("vertex_indices", [("count", "u1"), ("corners", "<i4", 3)])])
        faces["vertex_indices"]["count"] = 3
        faces["vertex_indices"]["corners"] = mesh.face.numpy()
        rows = np.empty(len(mesh.point), [("real", "<f4", 6), ("shade", "u1", 3)])
        rows["real"] = torch.cat([mesh.point, mesh.normal.double()], 1).float().numpy()
        rows["shade"] = (colour.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
        named = [
            *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
            *((c, "u1") for c in ("red", "green", "blue")),
        ]
        write_bytes(
            path, ply_file({"vertex": in_world(rows.view(named), mesh.point.numpy(), added), "face": faces})
        )
    write_offset(path, beside)


def _glb(mesh: Mesh, colour: Annotated[Tensor, "N 3"], origin: Origin) -> bytes:
    """Binary glTF, shown as it is: unlit, with 16-bit linear colours, which glTF asks for.

    Vertices are local, since glTF has float32; the node's translation is the origin.
    """
    import trimesh

    shade = np.ones((len(mesh.point), 4))
    shade[:, :3] = srgb_to_linear(np.clip(colour.double().numpy(), 0, 1))
    body = trimesh.Trimesh(
        mesh.point.float().numpy(),
        mesh.face.numpy(),
        vertex_normals=mesh.normal.numpy(),
        # trimesh rounds colours to 8 bits, which band in the dark where they are linear: they go in as an
        # attribute.
        vertex_attributes={"_COLOR_0": np.rint(shade * 65535).astype("<u2")},
        process=False,
    )

    def processed(tree: dict[str, Any]) -> None:
        """Make the attribute the vertices' colours and the material unlit, and move the mesh to its
        origin.
        """
        [primitive] = tree["meshes"][0]["primitives"]
        primitive["attributes"]["COLOR_0"] = colours = primitive["attributes"].pop("_COLOR_0")
        tree["accessors"][colours]["normalized"] = True
        primitive["material"] = 0
        rough = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        material = {
            "doubleSided": True,
            "pbrMetallicRoughness": rough,
            "extensions": {"KHR_materials_unlit": {}},
        }
        tree["materials"] = [material]
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        for node in tree["nodes"]:
            if "mesh" in node and any(origin):
                node["translation"] = list(origin)

    data = body.export(
        file_type="glb", include_normals=True, unitize_normals=False, tree_postprocessor=processed
    )
    assert isinstance(data, bytes)
    return data
