import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from tiny_world import World

from fprf.cli import main as cli
from fprf.datamanagers.parsers.config import parse_scene
from fprf.evaluation.metrics import psnr
from fprf.export.config import ExportConfig
from fprf.export.depth_maps import render_depth_maps
from fprf.splats.files import read_capture
from fprf.splats.views import camera_of, draw

LOOSE = ["--tolerance", "0.3", "--agree", "1", "--presence", "0"]
"""The tiny model has barely begun to agree with itself."""


def export(world: World, *args: str) -> int:
    return cli.main(["export", str(world.run), *args])


def names(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def columns(path: Path, *wanted: str) -> np.ndarray:
    data = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]
    return np.stack([data[name].ravel() for name in wanted], 1)


def test_everything_in_two_styles(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    references = ["--references", str(world.references[0]), "--styles", f"snow={world.references[1]}"]
    assert export(world, *LOOSE, *references, "--output", str(tmp_path)) == 0
    assert names(tmp_path) >= {
        "export.json", "transforms.json", "points.ply", "points.dusk.ply", "points.snow.ply",
        "mesh.ply", "mesh.dusk.glb", "splats.ply", "splats.dusk.ply", "splats.snow.ply",
        "splats.splat", "splats.dusk.splat", "splats.snow.splat",
        "luts/dusk/all.cube", "luts/dusk/region0.cube", "luts/snow/all.cube", "luts/snow/region3.cube",
    }  # fmt: skip
    made = json.loads((tmp_path / "export.json").read_text())
    assert made["styles"] == ["dusk", "snow"] and made["step"] == 15
    assert all(row["rms"] < row["rms_without"] for row in made["luts"].values()) and len(made["luts"]) == 2 * 5
    plain, dusk, snow = (trimesh.load(tmp_path / f"points{look}.ply") for look in ("", ".dusk", ".snow"))
    assert len(plain.vertices) == made["points"] > 100
    assert np.array_equal(plain.vertices, dusk.vertices) and np.array_equal(plain.vertices, snow.vertices)
    for a, b in ((plain, dusk), (plain, snow), (dusk, snow)):
        assert np.abs(a.colors[:, :3].astype(float) - b.colors[:, :3]).mean() > 2
    assert (tmp_path / "splats.splat").stat().st_size == 32 * made["splats"]
    told, share = capsys.readouterr().out, made["points"] / (made["points"] + made["floating"])
    assert "ply, splat" in told and f"points: {made['points']} of" in told and f"({share:.0%})" in told
    assert f"mesh: {made['vertices']} vertices" in told
    assert f"{made['pixels']['agreed'] / made['pixels']['seen']:.0%} of these" in told


def test_points_of_thick_surfaces_stay(world: World, tmp_path: Path) -> None:
    """Of a field that is trained too little to be sharp, a narrow piece of each ray holds but a part of the light."""
    assert export(world, "points", *LOOSE[:4], "--output", str(tmp_path)) == 0
    made = json.loads((tmp_path / "export.json").read_text())
    assert made["points"] > made["floating"]


def test_kinds_are_words_behind_the_run_or_a_flag(world: World, tmp_path: Path) -> None:
    assert export(world, "cameras", "--output", str(tmp_path / "a")) == 0
    assert export(world, "--kinds", "cameras", "--output", str(tmp_path / "b")) == 0
    assert names(tmp_path / "a") == names(tmp_path / "b") == {"export.json", "transforms.json"}


def test_a_single_file_is_in_the_style_that_is_asked_for(world: World, tmp_path: Path) -> None:
    assert export(world, "ply", *LOOSE, "--output", str(tmp_path / "all")) == 0
    assert export(world, *LOOSE, "--output", str(tmp_path / "one.ply")) == 0
    style = ["--references", str(world.references[0])]
    assert export(world, *LOOSE, *style, "--output", str(tmp_path / "dusk.ply")) == 0
    assert export(world, "splat", *LOOSE, *style, "--output", str(tmp_path / "g.ply")) == 0
    assert names(tmp_path) == {"all/points.ply", "all/export.json", "one.ply", "dusk.ply", "g.ply"}
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "all" / "points.ply").read_bytes()
    one, dusk = columns(tmp_path / "one.ply", "x", "red"), columns(tmp_path / "dusk.ply", "x", "red")
    assert np.array_equal(one[:, 0], dusk[:, 0]) and not np.array_equal(one[:, 1], dusk[:, 1])
    assert columns(tmp_path / "g.ply", "f_dc_0", "scale_0", "rot_0", "opacity").shape[1] == 4


def test_cameras_with_pictures_are_a_scene_of_its_own(world: World, tmp_path: Path) -> None:
    assert export(world, "cameras", "--images", "--references", str(world.references[0]), "--output", str(tmp_path)) == 0
    scene, before = parse_scene(tmp_path, 1, None), world.load().known
    assert np.allclose(scene.cameras.pose, before.cameras.pose, atol=1e-12)
    assert scene.train.tolist() == list(before.train) and scene.test.tolist() == list(before.test)
    assert cli.main(["stylize", str(world.run), "--references", str(world.references[0]), "--split", "all", "--no-matches",
                     "--output", str(tmp_path / "styled")]) == 0  # fmt: skip
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
    assert count("--views", "4")["views"] == 4 < every["views"]
    assert count("--side", "16")["points"] < every["points"]
    assert count("--agree", "6")["points"] < every["points"]
    assert count("--tolerance", "0.1")["points"] < every["points"]
    several = columns(tmp_path / "x" / "splats.ply", "f_dc_0")
    assert every["floating"] == 0
    count("--tolerance", "0.1", "--witnesses", "1")
    assert not np.array_equal(several, columns(tmp_path / "x" / "splats.ply", "f_dc_0")), "other colours, the same points"
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
    assert names(tmp_path) == {"dusk.cube"} and len(lines) == 4 + 5**3 and lines[1] == "LUT_3D_SIZE 5"


@pytest.mark.parametrize(
    ("args", "told"),
    [
        (["plx"], "'plx' is nothing to export"),
        (["--witnesses", "0"], "--witnesses: 0 must be at least 1"),
        (["--presence", "1.5"], "--presence: 1.5 must lie in [0.0, 1.0]"),
        (["--points", "0"], "--points: 0 must be at least 1"),
        (["--views", "1"], "--views: 1 must be at least 2"),
        (["--edge", "0"], "--edge: 0.0 must be above 0"),
        (["--tolerance", "2"], "--tolerance: 2.0 must lie in"),
        (["--styles", "A"], "write NAME=PHOTO,PHOTO or NAME=STYLE.json"),
        (["--styles", "a=absent.png"], "absent.png"),
        (["--styles", "a=x.png", "b=x.png", "--output", "OUT/one.ply"], "one file holds one style, 2 are asked for"),
        (["cameras", "--output", "OUT/one.splat"], "holds splat, not cameras"),
        (["lut"], "a lut is the way into a style; name one with --references"),
        (["--lut-size", "1"], "--lut-size: 1 must lie in [2, 129]"),
        (["ply", *LOOSE, "--presence", "1"], "no point is as present as 1 in the field; lower --presence"),
        (["ply", "--tolerance", "1e-6"], "no surface that two views agree on"),
    ],
)
def test_mistakes(world: World, args: list[str], told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    given = [arg.replace("OUT", str(tmp_path)) for arg in args]
    output = [] if "--output" in given else ["--output", str(tmp_path / "out")]
    assert export(world, *given, *output) == 2
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if not line.startswith("{")]
    assert out == "" and len(lines) == 1 and lines[0].startswith("error: ") and told in lines[0]
    assert names(tmp_path) == set()


def test_by_default_it_lies_in_the_run() -> None:
    assert ExportConfig().output is None and ExportConfig(run=Path("r")).kinds == ()


def test_splats_are_fitted_to_the_field(world: World, tmp_path: Path) -> None:
    """Trained ones come nearer to the field's own render than discs do; a style has the same ones in other colours."""
    more = ["--references", str(world.references[1])]
    assert export(world, "splat", *LOOSE, "--output", str(tmp_path / "discs")) == 0
    assert export(world, "splat", *LOOSE, *more, "--fit", "0.04", "--fit-cap", "500", "--output", str(tmp_path)) == 0
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
