"""Meshes of a sphere of exact depths: closed, in its place, in its colours, and read again by trimesh."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from analytic import RADIUS, globe

from fprf.export.mesh import Maps, Mesh, build_mesh, surface_nets, vertex_colours, write_mesh
from fprf.io.images import srgb_to_linear
from fprf.rendering.local_frame import read_offset

ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def seen() -> Maps:
    return globe(10)


@pytest.fixture(scope="module")
def mesh(seen: Maps) -> Mesh:
    return build_mesh(seen, edge=0.1)


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


def test_vertices_have_the_colours_of_what_views_see_there(seen: Maps, mesh: Mesh) -> None:
    around = mesh.point[:, 2].abs() < 0.7  # below nothing looks

    def apart(maps: Maps) -> torch.Tensor:
        return (vertex_colours(maps, mesh) - (0.5 + 0.5 * mesh.point)).abs()[around]

    assert float(apart(seen).mean()) < 0.01 and float(apart(seen).quantile(0.99)) < 0.05
    # A view that looks past all of it counts for nothing.
    dark = [rgb if view != 3 else 0 * rgb for view, rgb in enumerate(seen.rgb)]
    gone = [depth if view != 3 else torch.full_like(depth, torch.inf) for view, depth in enumerate(seen.depth)]
    without = apart(seen._replace(depth=gone, rgb=dark))
    assert float(without.mean()) < 0.015 and float(without.quantile(0.99)) < 0.08


def test_what_one_view_alone_claims_is_dropped(seen: Maps) -> None:
    """A view with a wall right before it: the others look through that wall."""
    wall = [depth if view != 3 else torch.full_like(depth, 1.5) for view, depth in enumerate(seen.depth)]
    spoilt = build_mesh(seen._replace(depth=wall), edge=0.1)
    assert float(spoilt.point.norm(dim=1).amax()) < RADIUS + 0.1


def test_it_is_the_same_far_from_the_origin(seen: Maps, mesh: Mesh) -> None:
    """World coordinates of a survey: 4.5e6 m from the origin."""
    shift = torch.tensor([4.5e6, 5e5, 200.0], dtype=torch.float64)
    far = build_mesh(seen._replace(cameras=seen.cameras.shifted(shift.tolist())), edge=0.1)
    assert abs(len(far.point) - len(mesh.point)) <= 0.02 * len(mesh.point)
    assert float(((far.point - shift).norm(dim=1) - RADIUS).abs().quantile(0.95)) < 0.03


def test_the_edge_follows_the_pixels_and_the_bound(seen: Maps, monkeypatch: pytest.MonkeyPatch) -> None:
    pixel = torch.cat([depth[depth.isfinite()] for depth in seen.depth]).median() / 50
    assert build_mesh(seen).edge == pytest.approx(2 * float(pixel), rel=1e-6)
    monkeypatch.setattr("fprf.export.mesh._MOST", 5_000)
    assert build_mesh(seen).edge > 3 * float(pixel)


def test_both_files_are_read_again_whole(mesh: Mesh, tmp_path: Path) -> None:
    colour = torch.rand(len(mesh.point), 3, generator=torch.Generator().manual_seed(0))
    write_mesh(tmp_path / "m.ply", mesh, colour, ZERO)
    write_mesh(tmp_path / "m.glb", mesh, colour, ZERO)
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
    write_mesh(tmp_path / "m.ply", mesh, colour, origin)
    write_mesh(tmp_path / "m.glb", mesh, colour, origin)
    glb = trimesh.load_scene(tmp_path / "m.glb", process=False)
    [node] = glb.graph.nodes_geometry
    matrix, name = glb.graph[node]
    assert np.array_equal(matrix[:3, 3], origin) and np.array_equal(glb.geometry[name].vertices, mesh.point.float().numpy())
    assert np.abs(trimesh.load(tmp_path / "m.ply", process=False).vertices - origin - mesh.point.numpy()).max() < 1e-8
    for ending in ("ply", "glb"):
        path = tmp_path / f"local.{ending}"
        write_mesh(path, mesh, colour, origin, local=True)
        whole = trimesh.load_scene(path, process=False)
        assert np.abs(whole.to_geometry().vertices - mesh.point.numpy()).max() < 1e-6
        assert read_offset(path) == origin
