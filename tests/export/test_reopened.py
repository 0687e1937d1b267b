"""What `fprf export` writes, opened again by other programs' readers: counts, bounds, colours agree."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from splatter import read_gaussians, read_splat
from tiny_world import World

from fprf.cli import main as cli

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
    assert (folder / json.loads((folder / "transforms.json").read_text())["ply_file_path"]).is_file()
    assert {path.name for path in (folder / "luts").iterdir()} == {"dusk", "snow"}
    seen = []
    for look in LOOKS:
        points = trimesh.load(folder / f"points{look}.ply")
        ply = read_gaussians((folder / f"splats{look}.ply").read_bytes())
        splat = read_splat((folder / f"splats{look}.splat").read_bytes())
        assert len(points.vertices) == len(ply.at) == len(splat.at) == made["points"] == made["splats"] > 100
        assert np.array_equal(points.vertices, first), "a style moves nothing"
        assert np.array_equal(np.float32(ply.at), np.float32(points.vertices))
        assert np.abs(ply.colour - points.colors[:, :3] / 255).max() <= 0.5 / 255 + 1e-6
        [glb] = trimesh.load_scene(folder / f"mesh{look}.glb", process=False).geometry.values()
        for mesh in (glb, trimesh.load(folder / f"mesh{look}.ply", process=False)):
            assert (len(mesh.vertices), len(mesh.faces)) == (made["vertices"], made["triangles"])
        seen.append(points.colors[:, :3].astype(float))
    assert all(np.abs(seen[a] - seen[b]).mean() > 2 for a, b in ((0, 1), (0, 2), (1, 2)))
