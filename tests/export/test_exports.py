"""Meshes against scenes that are known, and what `fprf export` writes, opened again by other programs'
readers and our own.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
import trimesh
from analytic import RADIUS, globe, ring
from tiny_world import World

from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.export.config import plan
from fprf.export.mesh import Maps, Mesh, build_mesh, surface_nets, vertex_colours, write_mesh
from fprf.io.images import srgb_to_linear
from fprf.rendering.cameras import Cameras
from fprf.rendering.local_frame import read_offset
from fprf.rendering.paths import transforms

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
    assert found.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.12), (
        "negative if it were inside out"
    )


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
    gone = [
        depth if view != 3 else torch.full_like(depth, torch.inf) for view, depth in enumerate(seen.depth)
    ]
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
    monkeypatch.setattr("fprf.export.mesh._MAX_LATTICE_POINTS", 5_000)
    assert build_mesh(seen).edge > 3 * float(pixel)


def test_both_files_are_read_again_whole(mesh: Mesh, tmp_path: Path) -> None:
    colour = torch.rand(len(mesh.point), 3, generator=torch.Generator().manual_seed(0))
    write_mesh(tmp_path / "m.ply", mesh, colour, ZERO)
    write_mesh(tmp_path / "m.glb", mesh, colour, ZERO)
    ply = trimesh.load(tmp_path / "m.ply", process=False)
    [glb] = trimesh.load_scene(tmp_path / "m.glb", process=False).geometry.values()
    for found in (ply, glb):
        assert np.array_equal(found.faces, mesh.face.numpy()) and np.array_equal(
            found.vertices, mesh.point.float().numpy()
        )
        assert np.allclose(found.bounds, [mesh.point.amin(0).numpy(), mesh.point.amax(0).numpy()], atol=1e-6)
        assert np.allclose(found.vertex_normals, mesh.normal.numpy(), atol=1e-3)
    assert np.array_equal(ply.visual.vertex_colors[:, :3], (colour * 255 + 0.5).to(torch.uint8).numpy())
    shade = np.asarray(glb.visual.vertex_attributes["color"])
    assert shade.dtype == np.uint16 and (shade[:, 3] == 65535).all()
    assert np.abs(shade[:, :3] / 65535 - srgb_to_linear(colour.double().numpy())).max() < 1e-5, (
        "glTF's colours are linear"
    )
    document = (tmp_path / "m.glb").read_bytes()
    assert document[:4] == b"glTF" and int.from_bytes(document[8:12], "little") == len(document)


def test_far_from_0_the_mesh_lies_where_the_capture_does(mesh: Mesh, tmp_path: Path) -> None:
    """PLY in float64, glTF by its node, both local where that is asked for."""
    origin = (500_000.0, -16.0, 5_600_000.0)
    colour = torch.rand(len(mesh.point), 3)
    write_mesh(tmp_path / "m.ply", mesh, colour, origin)
    write_mesh(tmp_path / "m.glb", mesh, colour, origin)
    glb = trimesh.load_scene(tmp_path / "m.glb", process=False)
    [node] = glb.graph.nodes_geometry
    matrix, name = glb.graph[node]
    assert np.array_equal(matrix[:3, 3], origin) and np.array_equal(
        glb.geometry[name].vertices, mesh.point.float().numpy()
    )
    assert (
        np.abs(trimesh.load(tmp_path / "m.ply", process=False).vertices - origin - mesh.point.numpy()).max()
        < 1e-8
    )
    for ending in ("ply", "glb"):
        path = tmp_path / f"local.{ending}"
        write_mesh(path, mesh, colour, origin, local=True)
        whole = trimesh.load_scene(path, process=False)
        assert np.abs(whole.to_geometry().vertices - mesh.point.numpy()).max() < 1e-6
        assert read_offset(path) == origin


LOOKS = {"": "plain", ".dusk": "dusk", ".snow": "snow"}


@pytest.fixture
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Written once."""
    made = tmp_path_factory.getbasetemp() / "exported"
    if made.exists():
        return made
    styles = [f"{name}={path}" for name, path in zip(("dusk", "snow"), world.references, strict=True)]
    few = ["--fit", "0.02", "--fit-cap", "400"]
    assert cli.main(["export", str(world.run), *few, "--styles", *styles, "--output", str(made)]) == 0
    return made


def test_all_files_of_one_geometry_agree(folder: Path) -> None:
    made = json.loads((folder / "export.json").read_text())
    first = read_gaussians((folder / "splats.ply").read_bytes()).at
    assert len(json.loads((folder / "transforms.json").read_text())["frames"]) == made["cameras"] == 10
    seen = []
    for look in LOOKS:
        ply = read_gaussians((folder / f"splats{look}.ply").read_bytes())
        splat = read_splat((folder / f"splats{look}.splat").read_bytes())
        assert len(ply.at) == len(splat.at) == made["gaussians"] > 50
        assert np.array_equal(ply.at, first), "a style moves nothing"
        assert np.array_equal(np.float32(ply.at), np.float32(splat.at))
        [glb] = trimesh.load_scene(folder / f"mesh{look}.glb", process=False).geometry.values()
        mesh = trimesh.load(folder / f"mesh{look}.ply", process=False)
        for each in (glb, mesh):
            assert (len(each.vertices), len(each.faces)) == (made["vertices"], made["triangles"])
        seen.append((ply.colour, mesh.visual.vertex_colors[:, :3] / 255))
    for kind in (0, 1):
        assert all(np.abs(seen[a][kind] - seen[b][kind]).mean() > 0.008 for a, b in ((0, 1), (0, 2), (1, 2)))


def test_a_folder_takes_the_usual_kinds_or_those_that_are_named(tmp_path: Path) -> None:
    assert plan([], tmp_path) == (("ply", "splat", "glb", "cameras"), tmp_path, None)
    assert plan(["splat", "ply", "splat"], Path("out")) == (("splat", "ply"), Path("out"), None)
    assert plan(["glb", "compressed.ply"], Path("out")).formats == ("compressed.ply",)
    assert plan(["glb"], Path("out")).paths("mesh", "dusk", ".ply", ".glb") == [
        Path("out/mesh.dusk.ply"),
        Path("out/mesh.dusk.glb"),
    ]


@pytest.mark.parametrize(
    ("kinds", "name", "kind"),
    [
        *(
            ([], "a.ply", "ply"),
            (["glb"], "a.ply", "glb"),
            ([], "a.SPLAT", "splat"),
            ([], "t.json", "cameras"),
        ),
        *(([], "a.compressed.ply", "compressed.ply"), (["sog"], "meta.json", "sog")),
    ],
)
def test_a_file_holds_what_its_ending_says(kinds: list[str], name: str, kind: str) -> None:
    assert plan(kinds, Path("to") / name) == ((kind,), Path("to"), Path("to") / name)
    assert plan(kinds, Path("to") / name).paths("splats", "dusk", ".x") == [Path("to") / name]


def written(folder: Path, cameras: Cameras, **more: object) -> dict[str, object]:
    files = [f"images/{k:02d}.png" for k in range(len(cameras))]
    (folder / "images").mkdir(parents=True)
    for file, (width, height) in zip(files, cameras.size.tolist(), strict=True):
        cv2.imwrite(str(folder / file), np.zeros((height, width, 3), dtype=np.uint8))
    document = transforms(cameras, files, train=[1, 2, 4], test=[0, 3], **more)  # type: ignore[arg-type]
    (folder / "transforms.json").write_text(json.dumps(document))
    return document


@pytest.mark.parametrize("kind", ["shared", "each", "opencv", "fisheye"])
def test_our_own_parser_reads_the_cameras_back(tmp_path: Path, kind: str) -> None:
    cameras = ring(5)
    if kind == "each":
        cameras = replace(cameras, focal=cameras.focal + torch.arange(5).double()[:, None])
    if kind == "opencv":
        bent = torch.tensor([0.1, -0.02, 0.003, -0.0004, 0.001, -0.002], dtype=torch.float64)
        cameras = replace(cameras, distortion=bent.repeat(5, 1), lens=torch.ones(5, dtype=torch.int64))
    if kind == "fisheye":
        bent = torch.tensor([0.1, -0.02, 0.003, -0.0004, 0.0, 0.0], dtype=torch.float64)
        cameras = replace(cameras, distortion=bent.repeat(5, 1), lens=torch.full((5,), 2))
    document = written(tmp_path, cameras)
    frames = document["frames"]
    assert isinstance(frames, list) and ("fl_x" in frames[0]) == (kind == "each") != ("fl_x" in document)
    scene = parse_scene(tmp_path, 1, None)
    for name in ("focal", "centre", "size", "distortion", "lens"):
        assert torch.equal(getattr(scene.cameras, name), getattr(cameras, name)), name
    assert torch.allclose(scene.cameras.pose, cameras.pose, atol=1e-12)
    assert scene.train.tolist() == [1, 2, 4] and scene.test.tolist() == [0, 3]


class Gaussians(NamedTuple):
    at: np.ndarray
    deviation: np.ndarray
    turn: np.ndarray
    """Quaternion w x y z."""
    colour: np.ndarray
    opacity: np.ndarray


def table(data: bytes) -> np.ndarray:
    """The vertices of a binary PLY, by nothing but its header."""
    head, _, body = data.partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    rows = []
    count = 0
    inside = False
    for line in head.decode("ascii").splitlines():
        word = line.split()
        if word[:1] == ["element"]:
            inside = word[1] == "vertex"
            count = int(word[2]) if inside else count
        elif word[:1] == ["property"] and inside:
            rows.append((word[2], kinds[word[1]]))
    return np.frombuffer(body, dtype=rows, count=count)


def read_gaussians(data: bytes) -> Gaussians:
    v = table(data)

    def columns(*names: str) -> np.ndarray:
        return np.stack([v[name] for name in names], 1).astype(float)

    return Gaussians(
        columns("x", "y", "z"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        0.5 + 0.5 / np.sqrt(np.pi) * columns("f_dc_0", "f_dc_1", "f_dc_2"),
        1 / (1 + np.exp(-v["opacity"].astype(float))),
    )


def read_splat(data: bytes) -> Gaussians:
    raw = np.frombuffer(data, dtype=np.uint8).reshape(-1, 32)
    real = np.ascontiguousarray(raw[:, :24]).view("<f4").astype(float)
    turn = (raw[:, 28:].astype(float) - 128) / 128
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return Gaussians(real[:, :3], real[:, 3:], turn, raw[:, 24:27] / 255.0, raw[:, 27] / 255.0)
