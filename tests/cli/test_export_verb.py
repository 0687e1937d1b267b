import json
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
from tiny_world import World

from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.evaluation.metrics import psnr
from fprf.export.depth_maps import render_depth_maps
from fprf.splats.files import read_capture
from fprf.splats.photographs import camera_of
from fprf.splats.views import draw

LOOSE = ["--tolerance", "0.3", "--agree", "1", "--presence", "0"]
"""The tiny model has barely begun to agree with itself."""


def export(world: World, *args: str) -> int:
    return cli.main(["export", str(world.run), *args])


def reds(path: Path) -> np.ndarray:
    return trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]["f_dc_0"]


def test_cameras_with_pictures_are_a_scene_of_its_own(world: World, tmp_path: Path) -> None:
    style = ["--references", str(world.references[0])]
    assert export(world, "cameras", "--images", *style, "--output", str(tmp_path)) == 0
    scene, before = parse_scene(tmp_path, 1, None), world.load().known
    assert np.allclose(scene.cameras.pose, before.cameras.pose, atol=1e-12)
    assert scene.train.tolist() == list(before.train) and scene.test.tolist() == list(before.test)
    styled = [*style, "--split", "all", "--no-matches", "--output", str(tmp_path / "styled")]
    assert cli.main(["stylize", str(world.run), *styled]) == 0
    for path, name in zip(scene.paths, before.names, strict=True):
        assert np.array_equal(cv2.imread(str(path)), cv2.imread(str(tmp_path / "styled" / f"{name}.png")))


def test_bounds_and_options_reach_the_files(world: World, tmp_path: Path) -> None:
    def count(*args: str) -> dict[str, float]:
        folder = tmp_path / "x"
        assert export(world, "splat", *LOOSE, *args, "--output", str(folder)) == 0
        made: dict[str, float] = json.loads((folder / "export.json").read_text())
        return made

    every = count()
    assert count("--points", "200")["points"] <= 200 < every["points"]
    assert count("--edge", "3")["finest_edge"] >= 3 > every["finest_edge"]
    assert count("--side", "16")["points"] < every["points"]
    assert count("--tolerance", "0.1")["points"] < every["points"]
    several = reds(tmp_path / "x" / "splats.ply")
    assert every["floating"] == 0
    count("--tolerance", "0.1", "--witnesses", "1")
    assert not np.array_equal(several, reds(tmp_path / "x" / "splats.ply")), "other colours, the same points"
    trained = world.load()
    known = trained.known
    [depth] = render_depth_maps(trained.model, known.cameras, known.train[:1], trained.config.render, side=32, reach=1e9).depth
    reach = ["--reach", str(float(depth.median()))]
    near = count(*reach)
    assert near["splats"] > near["points"] < every["points"]
    bare = count(*reach, "--no-sky")
    assert bare["splats"] == bare["points"] == near["points"]


def test_one_table_of_another_size(world: World, tmp_path: Path) -> None:
    style = ["--references", str(world.references[0])]
    assert export(world, "lut", *style, "--lut-size", "5", "--output", str(tmp_path / "dusk.cube")) == 0
    lines = (tmp_path / "dusk.cube").read_text().splitlines()
    assert [path.name for path in tmp_path.iterdir()] == ["dusk.cube"]
    assert len(lines) == 4 + 5**3 and lines[1] == "LUT_3D_SIZE 5"


def test_splats_are_fitted_to_the_field(world: World, tmp_path: Path) -> None:
    """Trained ones come nearer to the field's own render than discs do; a style has the same ones in other colours."""
    more = ["--references", str(world.references[1])]
    assert export(world, "splat", *LOOSE, "--output", str(tmp_path / "discs")) == 0
    assert export(world, "splat", *LOOSE, *more, "--fit", "0.08", "--fit-cap", "500", "--output", str(tmp_path)) == 0
    trained = world.load()
    cameras, view = trained.known.cameras, trained.known.test[0]
    shown = trained.render(cameras, view).rgb

    def quality(path: Path) -> float:
        capture = read_capture(path)
        return psnr(draw(capture.gaussians, camera_of(cameras, view), antialiased=capture.antialiased).image.clamp(0, 1), shown)

    assert quality(tmp_path / "splats.ply") > quality(tmp_path / "discs" / "splats.ply")
    plain, snow = (read_capture(tmp_path / f"splats{look}.ply").gaussians for look in ("", ".snow"))
    assert len(plain) <= 500 and torch.equal(plain.means, snow.means) and torch.equal(plain.logits, snow.logits)
    assert float((plain.colours - snow.colours).abs().mean()) > 0.02
    assert len(read_capture(tmp_path / "splats.snow.splat").gaussians) == len(snow)
