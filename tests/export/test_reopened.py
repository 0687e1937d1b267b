"""What `fprf export` and `fprf render` write, opened again by other programs' readers: counts, bounds, colours agree."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from splatter import read_gaussians, read_splat, table
from tiny_world import World

from fprf.cli import main as cli
from fprf.io.images import srgb_to_linear

LOOSE = ["--tolerance", "0.3", "--agree", "1", "--presence", "0", "--no-sky"]
LOOKS = {"": "plain", ".dusk": "dusk", ".snow": "snow"}


@pytest.fixture
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Written once."""
    made = tmp_path_factory.getbasetemp() / "exported"
    if made.exists():
        return made
    styles = [f"{name}={path}" for name, path in zip(("dusk", "snow"), world.references, strict=True)]
    words = ["export", str(world.run), *LOOSE, "--styles", *styles, "--lut-size", "9", "--output", str(made)]
    assert cli.main(words) == 0
    return made


def test_all_files_of_one_geometry_agree(folder: Path) -> None:
    made = json.loads((folder / "export.json").read_text())
    first = trimesh.load(folder / "points.ply").vertices
    seen = []
    for look in LOOKS:
        points = trimesh.load(folder / f"points{look}.ply")
        ply = read_gaussians((folder / f"splats{look}.ply").read_bytes())
        splat = read_splat((folder / f"splats{look}.splat").read_bytes())
        assert len(points.vertices) == len(ply.at) == len(splat.at) == made["points"] == made["splats"] > 100
        assert np.array_equal(points.vertices, first), "a style moves nothing"
        assert np.array_equal(np.float32(ply.at), np.float32(points.vertices))
        for at in (ply.at, splat.at):
            assert np.allclose([at.min(0), at.max(0)], points.bounds, atol=1e-6)
        assert np.abs(ply.colour - points.colors[:, :3] / 255).max() <= 0.5 / 255 + 1e-6
        order = np.lexsort(np.float32(splat.at).T), np.lexsort(np.float32(ply.at).T)
        assert np.abs(splat.colour[order[0]] - ply.colour[order[1]]).max() <= 0.5 / 255 + 1e-6
        raw = table((folder / f"points{look}.ply").read_bytes())
        assert np.array_equal(np.stack([raw[c] for c in ("red", "green", "blue")], 1), points.colors[:, :3])
        seen.append(points.colors[:, :3].astype(float))
    assert all(np.abs(seen[a] - seen[b]).mean() > 2 for a, b in ((0, 1), (0, 2), (1, 2)))


def test_both_meshes_agree_in_every_look(folder: Path) -> None:
    made = json.loads((folder / "export.json").read_text())
    for look in LOOKS:
        ply = trimesh.load(folder / f"mesh{look}.ply", process=False)
        [glb] = trimesh.load_scene(folder / f"mesh{look}.glb", process=False).geometry.values()
        for mesh in (ply, glb):
            assert (len(mesh.vertices), len(mesh.faces)) == (made["vertices"], made["triangles"])
        assert np.array_equal(ply.vertices, glb.vertices) and np.array_equal(ply.faces, glb.faces)
        shade = np.asarray(glb.visual.vertex_attributes["color"])[:, :3] / 65535
        assert np.abs(shade - srgb_to_linear(ply.visual.vertex_colors[:, :3] / 255)).max() < 2.3 / 255


def test_cameras_are_those_of_the_capture(folder: Path, world: World) -> None:
    document, capture = (json.loads((place / "transforms.json").read_text()) for place in (folder, world.town))
    found, wanted = ({Path(frame["file_path"]).stem: frame for frame in of["frames"]} for of in (document, capture))
    assert found.keys() == wanted.keys()
    for name, frame in wanted.items():
        assert np.allclose(found[name]["transform_matrix"], frame["transform_matrix"], atol=1e-9)
    for key in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
        assert document[key] == pytest.approx(capture.get(key, capture["frames"][0].get(key)))
    assert set(document["train_filenames"]).isdisjoint(document["test_filenames"])
    assert (folder / document["ply_file_path"]).is_file()


def test_lookup_tables_bring_colours_nearer_to_the_style(folder: Path) -> None:
    """Points' colours through the table, by nearest nodes, against the points' colours in the style."""
    plain = trimesh.load(folder / "points.ply").colors[:, :3] / 255
    for name in ("dusk", "snow"):
        styled = trimesh.load(folder / f"points.{name}.ply").colors[:, :3] / 255
        # [blue, green, red, 3], as Adobe's specification orders it
        cube = np.loadtxt(folder / "luts" / name / "all.cube", skiprows=4).reshape(9, 9, 9, 3)
        assert cube.min() >= 0 and cube.max() <= 1
        node = np.rint(plain * 8).astype(int)
        through = cube[node[:, 2], node[:, 1], node[:, 0]]
        assert np.square(through - styled).mean() < 0.5 * np.square(plain - styled).mean()


def test_films_have_their_frames_and_colours(world: World, tmp_path: Path) -> None:
    words = ["render", str(world.run), "--path", "dataset", "--frames", "4", "--references", str(world.references[0])]
    assert cli.main([*words, "--output", str(tmp_path / "film.mp4")]) == 0
    assert cli.main([*words, "--output", str(tmp_path / "frames")]) == 0
    stills = [cv2.imread(str(path)) for path in sorted((tmp_path / "frames").glob("*.png"))]
    film, shown = cv2.VideoCapture(str(tmp_path / "film.mp4")), []
    while (got := film.read())[0]:
        shown.append(got[1])
    assert len(shown) == len(stills) > 1 and shown[0].shape == stills[0].shape
    for one, other in zip(shown, stills, strict=True):
        assert np.abs(one.astype(float) - other).mean() < 8
