"""Runs of a capture in projected metres: as good as in its own coordinates, and everything comes out where
the capture is.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from moved_scene import UTM, moved_scene
from parts_world import small
from tiny_world import World, parameters, tiny

import fprf
from benchmarks.town.write import write_town
from fprf.cli.main import main
from fprf.datamanagers.parsers.config import parse_scene
from fprf.io.images import write_image
from fprf.page.films import write_film_files
from fprf.page.looks import Look
from fprf.page.messages import Camera, Film
from fprf.page.state import PageKeyframe
from fprf.rendering.local_frame import read_offset
from fprf.rendering.paths import read_camera_path
from fprf.splats.files import read_capture
from fprf.splats.pinholes import camera_of
from fprf.splats.scene import SplatScene
from fprf.training.driver import train
from fprf.training.field_scene import load_run
from fprf.training.loading import open_run
from fprf.training.run import Run

SPLATS = ["--downscale", "1", "--initial", "300", "--cap", "400", "--steps", "40"]


@pytest.fixture
def utm(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The town in UTM; written once, as are the runs."""
    folder = tmp_path_factory.getbasetemp() / "utm" / "town"
    return folder if folder.exists() else moved_scene(world.town, folder, UTM)


@pytest.fixture
def fields(utm: Path) -> Path:
    run = utm.parent / "fields"
    if not run.exists():
        train(tiny(utm, run), "fprf-lite", quiet=True)
    return run


@pytest.fixture
def splats(utm: Path) -> Path:
    run = utm.parent / "splats"
    if not run.exists():
        assert main(["train", "fprf-splats", "--data", str(utm), *SPLATS, "--output", str(run)]) == 0
    return run


def psnr(run: Path, *flags: str) -> float:
    assert main(["eval", str(run), "--images", "false", *flags]) == 0
    return float(json.loads((run / "metrics.json").read_text())["psnr"])


def test_fields_are_as_good_and_go_on_as_they_are(
    world: World, fields: Path, utm: Path, tmp_path: Path
) -> None:
    known = Run(fields).load_known()
    assert (
        np.abs(np.array(known.facts.origin) - UTM).max() < 64
        and float(known.cameras.pose[:, :, 3].abs().max()) < 200
    )
    shutil.copytree(world.run, tmp_path / "own")
    assert psnr(fields) == pytest.approx(psnr(tmp_path / "own"), abs=0.1)
    shutil.copytree(fields, tmp_path / "more")
    config = replace(tiny(utm, tmp_path / "more"), steps=20)
    train(config, "fprf-lite", quiet=True)
    train(replace(config, output=tmp_path / "once"), "fprf-lite", quiet=True)
    assert Run(tmp_path / "more").load_known().facts.origin == known.facts.origin
    assert parameters(Run(tmp_path / "more"), 20).keys() == parameters(Run(tmp_path / "once"), 20).keys()


def test_surfaces_are_exported_where_the_capture_is(fields: Path, tmp_path: Path) -> None:
    origin = np.array(load_run(fields, "cpu").origin)
    world = tmp_path / "world"
    local = tmp_path / "local"
    kinds = ["ply", "splat", "glb", "cameras"]
    few = ["--fit", "1e-6", "--fit-cap", "200"]  # as many steps, one, in both
    assert main(["export", str(fields), *kinds, *few, "--output", str(world)]) == 0
    assert main(["export", str(fields), *kinds, *few, "--local", "true", "--output", str(local)]) == 0
    for name in ("splats.ply", "mesh.ply", "mesh.glb"):
        there, here = (
            np.asarray(trimesh.load_scene(folder / name, process=False).to_geometry().vertices)
            for folder in (world, local)
        )
        assert len(there) > 50 and np.abs(here).max() < 1e4
        # A local float32 has the same digits.
        assert np.abs(there - origin - here).max() < 2e-7 * np.abs(here).max()
        assert read_offset(local / name) == tuple(origin) and read_offset(world / name) == (0, 0, 0)
    assert (world / "splats.splat").read_bytes() == (local / "splats.splat").read_bytes()
    assert read_offset(world / "splats.splat") == read_offset(local / "splats.splat") == tuple(origin)
    given = [np.array([f["transform_matrix"] for f in json.loads((folder / "transforms.json").read_text())["frames"]])
             for folder in (world, local)]  # fmt: skip
    assert np.abs(given[0][:, :3, 3] - origin - given[1][:, :3, 3]).max() < 1e-8


def test_gaussians_are_as_good_and_lie_where_the_capture_is(
    world: World, splats: Path, utm: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own"
    assert main(["train", "fprf-splats", "--data", str(world.town), *SPLATS, "--output", str(own)]) == 0
    assert psnr(splats) == pytest.approx(psnr(own), abs=0.2)
    assert psnr(splats, "--fit-poses", "true") == pytest.approx(psnr(own, "--fit-poses", "true"), abs=0.2)
    scene = open_run(splats, "cpu").scene
    assert isinstance(scene, SplatScene)
    for flags in ([], ["--local", "true"], ["--plain", "true"]):
        assert (
            main(
                [
                    "export",
                    str(splats),
                    "ply",
                    "splat",
                    "cameras",
                    *flags,
                    "--output",
                    str(tmp_path / "files"),
                ]
            )
            == 0
        )
        for name in ("splats.ply", "splats.splat"):
            capture = read_capture(tmp_path / "files" / name)
            found = capture.gaussians.means.double().numpy() + (np.array(capture.origin) - scene.origin)
            assert np.abs(found - scene.gaussians.means.double().numpy()).max() < 1e-6 * np.abs(found).max()
    assert main(["export", str(splats), "cameras", "--output", str(tmp_path / "again"), "--images"]) == 0
    again = parse_scene(tmp_path / "again", 1, None)
    first = parse_scene(utm, 1, None)
    there = [each.cameras.pose[:, :, 3].numpy() + each.origin for each in (again, first)]
    assert np.abs(there[0] - there[1]).max() < 1e-8


def test_paths_and_places_are_given_in_the_capture_s_coordinates(
    world: World, splats: Path, utm: Path, tmp_path: Path
) -> None:
    scene = fprf.load(splats)
    frames = json.loads((utm / "transforms.json").read_text())["frames"]
    place = {frame["file_path"].rpartition("/")[2]: np.array(frame["transform_matrix"]) for frame in frames}
    pose = next(matrix for name, matrix in place.items() if Path(name).stem == scene.names[2])
    fov = 2 * np.degrees(np.arctan(float(scene.cameras.size[2, 1] / scene.cameras.focal[2, 1] / 2)))
    path = {"camera_type": "perspective", "render_width": 32, "render_height": 24, "fps": 1}
    path["camera_path"] = [{"camera_to_world": pose.flatten().tolist(), "fov": fov}]
    (tmp_path / "path.json").write_text(json.dumps(path))
    wanted = scene.render(2).rgb
    shown = next(scene.film(scene.path(str(tmp_path / "path.json")))).rgb
    assert torch.allclose(shown, wanted, atol=1e-3)
    at = pose[:3, 3]
    aimed = scene.camera_at(at.tolist(), (at - 10 * pose[:3, 2]).tolist(), fov=fov, width=32, height=24)
    assert np.abs(scene.cameras.pose[2, :, 3].numpy() - at).max() < 1e-8
    assert float((scene.render(aimed).rgb - wanted).abs().mean()) < 0.05, (
        "level, where the photograph may lean a little"
    )
    # The viewer's film says where it flew in the capture's coordinates, too.
    cameras = scene.trained.known.cameras
    origin = scene.trained.scene.origin
    pinhole = camera_of(cameras, 2)
    axes = tuple(tuple(row) for row in pinhole.world_to_camera[:3, :3].tolist())
    key = PageKeyframe(
        Camera(tuple(cameras.pose[2, :, 3].tolist()), axes, (30, 30, 16, 12), (32, 24)), Look()
    )
    write_film_files(tmp_path, (key, key), Film(seconds=0.5, side=32), scene.trained.scene)
    written = json.loads((tmp_path / "path.json").read_text())["camera_path"][0]["camera_to_world"]
    assert np.abs(np.array(written).reshape(4, 4)[:3, 3] - at).max() < 1e-6
    back = read_camera_path(tmp_path / "path.json", origin)[0]
    assert torch.allclose(back.pose[0, :, 3], cameras.pose[2, :, 3], atol=1e-6)
    # A pin on one half of the Gaussians: those beyond the middle of the scene along x.
    write_image(tmp_path / "white.png", np.full((24, 32, 3), 250, np.uint8))
    gaussians = scene.trained.scene.gaussians  # type: ignore[attr-defined]
    middle = float(gaussians.means[:, 0].median()) + origin[0]
    photographs = [str(world.references[0]), str(tmp_path / "white.png")]
    pins = {"in": f"box:{middle},-inf,-inf:inf,inf,inf=white.png", "none": "box:-9,-9,-9:9,9,9=white.png"}
    own = {name: scene.stylize(photographs, pin=[pin]).restyle for name, pin in pins.items()}
    recoloured = {name: scene.trained.scene.restyled(look).shown.colours for name, look in own.items()}  # type: ignore[attr-defined]
    changed = (recoloured["in"] - recoloured["none"]).abs().amax(1) > 1e-3
    right = gaussians.means[:, 0].double() + origin[0] >= middle
    assert not bool(changed[~right].any()) and float(changed[right].double().mean()) > 0.5


def test_cells_and_blocks_are_in_the_local_frame(world: World, utm: Path, tmp_path: Path) -> None:
    town = world.folder / "wide"
    if not town.exists():
        write_town(town, seed=0, palette="day", views=10, width=96, height=72)
    scores = []
    for name, data in (("own", town), ("utm", moved_scene(town, tmp_path / "utm", UTM))):
        cells = tmp_path / f"{name} cells"
        blocks = tmp_path / f"{name} blocks"
        assert (
            main(
                ["train", "fprf-splats", "--data", str(data), *SPLATS, "--cells", "2", "--output", str(cells)]
            )
            == 0
        )
        train(small(data, blocks), "fprf-lite", quiet=True)
        scores.append([psnr(cells), psnr(blocks)])
    assert scores[1] == pytest.approx(scores[0], abs=0.25)
    bounds = json.loads((tmp_path / "utm cells" / "cells.json").read_text())["cells"]
    assert max(abs(x) for cell in bounds for x in (*cell["low"], *cell["high"]) if x is not None) < 1000
    done = tmp_path / "utm blocks" / "blocks" / "00" / "done.json"
    stamp = done.stat().st_mtime_ns
    train(small(tmp_path / "utm", tmp_path / "utm blocks"), "fprf-lite", quiet=True)
    assert done.stat().st_mtime_ns == stamp, "a finished block stays"
