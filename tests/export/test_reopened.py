"""What `fprf export` writes, opened again by other programs' readers: counts, places and colours agree."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from splatter import read_gaussians, read_splat
from tiny_world import World

from fprf.cli import main as cli

LOOKS = {"": "plain", ".dusk": "dusk", ".snow": "snow"}


@pytest.fixture
def folder(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Written once."""
    made = tmp_path_factory.getbasetemp() / "exported"
    if made.exists():
        return made
    styles = [f"{name}={path}" for name, path in zip(("dusk", "snow"), world.references, strict=True)]
    few = ["--fit", "0.02", "--fit-cap", "400", "--lut-size", "9"]
    assert cli.main(["export", str(world.run), *few, "--styles", *styles, "--output", str(made)]) == 0
    return made


def test_all_files_of_one_geometry_agree(folder: Path) -> None:
    made = json.loads((folder / "export.json").read_text())
    first = read_gaussians((folder / "splats.ply").read_bytes()).at
    assert {path.name for path in (folder / "luts").iterdir()} == {"dusk", "snow"}
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
