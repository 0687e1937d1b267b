"""Meshes of a sphere of exact depths: closed, in its place, and read again by trimesh."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from analytic import RADIUS, globe

from fprf.errors import DataError
from fprf.export.depth_maps import DepthMaps
from fprf.export.mesh import Mesh, build_mesh, surface_nets, write_mesh_glb, write_mesh_ply
from fprf.export.point_cloud import Cloud, fuse
from fprf.io.images import srgb_to_linear
from fprf.rendering.local_frame import read_offset

ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def seen() -> tuple[DepthMaps, Cloud]:
    maps = globe(10)
    return maps, fuse(maps, edge=0.1, most=10**6, tolerance=0.02, agree=2)


@pytest.fixture(scope="module")
def mesh(seen: tuple[DepthMaps, Cloud]) -> Mesh:
    return build_mesh(*seen, edge=0.1)


@pytest.mark.parametrize("radius", [3.3, 5.0, 9.7])
def test_surface_nets_of_a_ball_are_closed_and_turned_outwards(radius: float) -> None:
    """Of its exact signed distance."""
    cell = torch.cartesian_prod(*(torch.arange(-12, 13),) * 3)
    at, face = surface_nets(cell, cell.double().norm(dim=1) - radius)
    found = trimesh.Trimesh(at.numpy(), face.numpy(), process=False)
    assert found.is_watertight and found.is_winding_consistent and found.euler_number == 2
    assert np.abs(np.linalg.norm(found.vertices, axis=1) - radius).max() < 0.2
    assert found.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.12), "negative if it were inside out"


def test_the_mesh_lies_on_the_sphere_with_its_normals(mesh: Mesh) -> None:
    away = mesh.point.norm(dim=1)
    assert float((away - RADIUS).abs().quantile(0.95)) < 0.03
    outwards = torch.nn.functional.normalize(mesh.point, dim=1)
    assert float((outwards * mesh.normal).sum(1).quantile(0.05)) > 0.9
    assert torch.allclose(mesh.normal.norm(dim=1), torch.ones(len(mesh.point)), atol=1e-5)
    assert int(mesh.face.amax()) == len(mesh.point) - 1 and len(torch.unique(mesh.face)) == len(mesh.point)


def test_both_files_are_read_again_whole(mesh: Mesh, tmp_path: Path) -> None:
    colour = torch.rand(len(mesh.point), 3, generator=torch.Generator().manual_seed(0))
    write_mesh_ply(tmp_path / "m.ply", mesh, colour, ZERO)
    write_mesh_glb(tmp_path / "m.glb", mesh, colour, ZERO)
    ply = trimesh.load(tmp_path / "m.ply", process=False)
    [glb] = trimesh.load_scene(tmp_path / "m.glb", process=False).geometry.values()
    for found in (ply, glb):
        assert np.array_equal(found.faces, mesh.face.numpy()) and np.array_equal(found.vertices, mesh.point.float().numpy())
        assert np.allclose(found.bounds, [mesh.point.amin(0).numpy(), mesh.point.amax(0).numpy()], atol=1e-6)
        assert np.allclose(found.vertex_normals, mesh.normal.numpy(), atol=1e-3)
    assert np.array_equal(ply.visual.vertex_colors[:, :3], (colour * 255 + 0.5).to(torch.uint8).numpy())
    shade = np.asarray(glb.visual.vertex_attributes["color"])
    assert shade.dtype == np.uint16 and (shade[:, 3] == 65535).all()
    assert np.abs(shade[:, :3] / 65535 - srgb_to_linear(colour.double().numpy())).max() < 1e-5, "glTF's colours are linear"
    document = (tmp_path / "m.glb").read_bytes()
    assert document[:4] == b"glTF" and int.from_bytes(document[8:12], "little") == len(document)


def test_far_from_0_the_mesh_lies_where_the_capture_does(mesh: Mesh, tmp_path: Path) -> None:
    """PLY in float64, glTF by its node, both local where that is asked for."""
    origin, colour = (500_000.0, -16.0, 5_600_000.0), torch.rand(len(mesh.point), 3)
    write_mesh_ply(tmp_path / "m.ply", mesh, colour, origin)
    write_mesh_glb(tmp_path / "m.glb", mesh, colour, origin)
    glb = trimesh.load_scene(tmp_path / "m.glb", process=False)
    [node] = glb.graph.nodes_geometry
    matrix, name = glb.graph[node]
    assert np.array_equal(matrix[:3, 3], origin) and np.array_equal(glb.geometry[name].vertices, mesh.point.float().numpy())
    assert np.abs(trimesh.load(tmp_path / "m.ply", process=False).vertices - origin - mesh.point.numpy()).max() < 1e-8
    for write, ending in ((write_mesh_ply, "ply"), (write_mesh_glb, "glb")):
        path = tmp_path / f"local.{ending}"
        write(path, mesh, colour, origin, local=True)
        whole = trimesh.load_scene(path, process=False)
        assert np.abs(whole.to_geometry().vertices - mesh.point.numpy()).max() < 1e-6
        assert read_offset(path) == origin


def test_a_lattice_too_coarse_for_anything_is_a_clear_mistake(seen: tuple[DepthMaps, Cloud]) -> None:
    with pytest.raises(DataError, match="no surface for a mesh; raise --mesh-edge"):
        build_mesh(*seen, edge=50.0)
