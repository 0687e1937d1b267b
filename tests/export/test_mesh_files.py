"""Meshes of a sphere of exact depths: closed, in its place, and read again by trimesh and drawn by a renderer of triangles."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from analytic import RADIUS, globe
from rasters import draw_points, draw_triangles, psnr

from fprf.errors import DataError
from fprf.export.mesh import (
    Mesh,
    build_mesh,
    components,
    integrate,
    lattice_near,
    surface_nets,
    vertex_normals,
    write_mesh_glb,
    write_mesh_ply,
)
from fprf.export.point_cloud import fuse
from fprf.io.images import srgb_to_linear

ZERO = torch.zeros(3, dtype=torch.float64)


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    maps = globe(10)
    return build_mesh(maps, fuse(maps, edge=0.1, most=10**6, tolerance=0.02, agree=2), edge=0.1)


def ball(radius: float, side: int = 24) -> trimesh.Trimesh:
    """Surface nets of an exact signed distance."""
    axis = torch.arange(-side // 2, side // 2 + 1)
    cell = torch.cartesian_prod(axis, axis, axis)
    at, face = surface_nets(cell, cell.double().norm(dim=1) - radius)
    return trimesh.Trimesh(at.numpy(), face.numpy(), process=False)


@pytest.mark.parametrize("radius", [3.3, 5.0, 9.7])
def test_surface_nets_of_a_ball_are_closed_and_turned_outwards(radius: float) -> None:
    found = ball(radius)
    assert found.is_watertight and found.is_winding_consistent and found.euler_number == 2
    assert np.abs(np.linalg.norm(found.vertices, axis=1) - radius).max() < 0.2
    assert found.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.12), "negative if it were inside out"


def test_surface_nets_without_a_surface_are_empty() -> None:
    cell = torch.cartesian_prod(*(torch.arange(4),) * 3)
    at, face = surface_nets(cell, torch.ones(64))
    assert at.shape == (0, 3) and face.shape == (0, 3)


def test_distances_are_positive_outside() -> None:
    maps = globe(10)
    cell, origin, edge = lattice_near(fuse(maps, edge=0.1, most=10**6, tolerance=0.02, agree=2), 0.1, 10**6)
    lattice = integrate(maps, cell, origin, edge)
    away = (origin + edge * lattice.cell.double()).norm(dim=1) - RADIUS
    clear = away.abs() > 0.06
    agrees = (lattice.value > 0) == (away > 0)
    assert float(agrees[clear].double().mean()) > 0.97 and lattice.value.abs().amax() <= 1
    coarse = lattice_near(fuse(maps, edge=0.1, most=10**6, tolerance=0.02, agree=2), 0.1, 20_000)
    assert len(coarse[0]) <= 20_000 and coarse[2] > 0.1, "wider until it fits"


def test_the_mesh_lies_on_the_sphere_with_its_normals(mesh: Mesh) -> None:
    away = mesh.point.norm(dim=1)
    assert float((away - RADIUS).abs().quantile(0.95)) < 0.03
    outwards = torch.nn.functional.normalize(mesh.point, dim=1)
    assert float((outwards * mesh.normal).sum(1).quantile(0.05)) > 0.9
    assert torch.allclose(mesh.normal.norm(dim=1), torch.ones(len(mesh.point)), atol=1e-5)
    assert int(mesh.face.amax()) == len(mesh.point) - 1 and len(torch.unique(mesh.face)) == len(mesh.point)


def test_a_lattice_too_coarse_for_anything_is_a_clear_mistake() -> None:
    maps = globe(10)
    cloud = fuse(maps, edge=0.1, most=10**6, tolerance=0.02, agree=2)
    with pytest.raises(DataError, match="no surface for a mesh; raise --mesh-edge"):
        build_mesh(maps, cloud, edge=50.0)


def test_components_of_three_balls() -> None:
    """Against joining the ends of edges one by one."""
    balls = trimesh.util.concatenate([ball(3.0), ball(4.0), ball(2.5)])
    label = components(len(balls.vertices), torch.from_numpy(np.array(balls.faces))).tolist()
    parts = list(range(len(balls.vertices)))

    def top(k: int) -> int:
        while parts[k] != k:
            k = parts[k]
        return k

    for a, b in balls.edges.tolist():
        low, high = sorted((top(a), top(b)))
        parts[high] = low
    assert label == [top(k) for k in range(len(parts))] and len(set(label)) == 3


def test_vertex_normals_of_a_box_point_out_of_its_corners() -> None:
    box = trimesh.creation.box()
    normal = vertex_normals(torch.tensor(np.array(box.vertices)), torch.from_numpy(np.array(box.faces))).numpy()
    assert ((normal * box.vertices).sum(1) > 0.5).all()


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


def test_a_mesh_drawn_from_its_file_is_the_sphere(mesh: Mesh, tmp_path: Path) -> None:
    """White on black from a place that no view had: the outline is the sphere's, to a pixel."""
    write_mesh_ply(tmp_path / "m.ply", mesh, torch.ones(len(mesh.point), 3), ZERO)
    found = trimesh.load(tmp_path / "m.ply", process=False)
    pose = np.array([[1, 0, 0, 0], [0, 0, -1, -4.0], [0, 1, 0, 0]], dtype=float)
    image, covered = draw_triangles(found.vertices, found.faces, found.visual.vertex_colors[:, :3] / 255, pose, 60.0, (64, 48))
    assert np.array_equal(image, np.repeat(covered[..., None], 3, 2).astype(float))
    y, x = np.mgrid[:48, :64] + 0.5
    way = np.stack([(x - 32) / 60, np.ones_like(x), (24 - y) / 60], -1)
    miss = 4 * np.sqrt(1 - (way[..., 1] / np.linalg.norm(way, axis=-1)) ** 2)
    assert covered[miss < 0.93].all() and not covered[miss > 1.07].any()
    dots, there = draw_points(found.vertices, np.ones((len(found.vertices), 3)), pose, 60.0, (64, 48))
    assert there[miss < 0.9].mean() > 0.98 and psnr(dots, image) > 10


def test_the_judge_of_triangles_is_right_about_depth_and_perspective() -> None:
    """A wall that leans away, with colours straight in the world, and a nearer card before it."""
    wall = np.array([[-2, -1.5, -2.0], [2, -1.5, -6.0], [2, 1.5, -6.0], [-2, 1.5, -2.0]])
    card = np.array([[-0.2, -0.2, -1.5], [0.2, -0.2, -1.5], [0.0, 0.2, -1.5]])
    point, face = np.concatenate([wall, card]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    colour = np.concatenate([np.repeat((wall[:, :1] + 2) / 4, 3, 1), np.ones((3, 3))])
    pose = np.concatenate([np.eye(3), np.zeros((3, 1))], 1)
    image, covered = draw_triangles(point, face, colour, pose, 40.0, (60, 40))
    way = (np.arange(60) + 0.5 - 30) / 40  # x / -z
    place = 4 * way / (1 - way)  # where the ray meets x = -z - 4 ... the wall's plane z = -(x + 4)
    row = np.abs(place) < 1.9
    assert np.allclose(image[2, row & covered[2], 0], ((place + 2) / 4)[row & covered[2]], atol=1e-9)
    assert (image[20, 28:32] == 1).all(), "the card is in front"
    assert psnr(image, image) == pytest.approx(99, abs=0.1)
