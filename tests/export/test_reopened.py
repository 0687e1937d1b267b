"""What `fprf export` writes, opened again by other programs' readers and our own."""

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
import trimesh
from analytic import ring
from tiny_world import World

from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.export.config import plan
from fprf.rendering.camera_path import transforms
from fprf.rendering.cameras import Cameras

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
        *(([], "a.ply", "ply"), (["glb"], "a.ply", "glb"), ([], "a.SPLAT", "splat"), ([], "t.json", "cameras")),
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
    rows, count, inside = [], 0, False
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
