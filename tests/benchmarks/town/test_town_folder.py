"""The folder on disk and the parser: complete, atomic, reused."""

import json

import cv2
import numpy as np
import pytest
import torch
from town_views import project

from benchmarks.town import write
from benchmarks.town.layout import build_town
from benchmarks.town.palettes import palette
from benchmarks.town.render import render, walk
from benchmarks.town.surface import SKY
from benchmarks.town.write import TownSettings, cached_town, is_town, read_truth, write_town
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import DataError

SMALL = {"seed": 2, "palette": "autumn", "views": 9, "width": 24, "height": 18}
TINY = {**SMALL, "views": 2}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("towns") / "town"
    write_town(path, **SMALL)
    return path


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "cache" / "fprf"


def test_files_are_the_pictures(folder):
    town, views = build_town(2), walk(seed=2, views=9, width=24, height=18)
    for k in (0, 7):
        shot = render(town, views[k], palette("autumn"))
        assert np.array_equal(cv2.imread(str(folder / f"images/{k:04d}.png"))[..., ::-1], shot.rgb)
        depth, kinds = read_truth(folder, k)
        assert np.array_equal(depth, shot.depth) and np.array_equal(kinds, shot.labels)
        assert np.array_equal(np.isinf(depth), kinds == SKY)


def test_points_lie_on_surfaces(folder):
    with np.load(folder / "points.npz") as stored:
        xyz, rgb = stored["xyz"], stored["rgb"]
    assert xyz.shape == rgb.shape and len(xyz) > 7 * 100 and xyz[:, 2].min() > -0.01
    assert (xyz.dtype, rgb.dtype) == (np.float32, np.uint8)
    row, column, distance = project(walk(seed=2, views=9, width=24, height=18)[1], xyz[: write._POINTS])
    np.testing.assert_allclose(distance, read_truth(folder, 1)[0][row, column], rtol=1e-4)


def test_a_damaged_folder_is_rendered_again(tmp_path):
    path = tmp_path / "town"
    write_town(path, **TINY)
    (path / "images/0001.png").unlink()
    write_town(path, **TINY)
    assert (path / "images/0001.png").is_file()
    write_town(path, **{**TINY, "palette": "night"})
    assert json.loads((path / "palette.json").read_text())["name"] == "night"
    assert [p.name for p in tmp_path.iterdir()] == ["town"]


def test_somebody_elses_folder_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match="not a town"):
        write_town(tmp_path, **SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    assert not is_town(tmp_path)


def test_the_cached_town_is_rendered_once(cache, monkeypatch):
    folder = cached_town(**TINY)
    assert folder == cache / f"town-{TownSettings(**TINY).key}" / "town"
    scene = parse_scene(folder, 1, None)
    assert scene.name == "town" and len(scene.cameras) == 2
    assert (scene.train.tolist(), scene.test.tolist()) == ([1], [0])
    assert scene.points is not None
    assert scene.cameras.size.tolist() == [[24, 18]] * 2
    poses = np.stack([view.pose for view in walk(seed=2, views=2, width=24, height=18)])
    torch.testing.assert_close(scene.cameras.pose, torch.from_numpy(poses), atol=1e-12, rtol=0)
    monkeypatch.setattr(write, "_fill", lambda *_: pytest.fail("rendered again"))
    assert cached_town(**TINY) == folder
