"""Captures in the format of Mission Bay: two cameras, exposure, rays of every pixel; read, refused, and trained."""

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from record_files import example, record, town_records

from fprf.datamanagers.images import load_image
from fprf.datamanagers.parsers.config import BlockNerfConfig, parse_scene, recognise
from fprf.errors import ConfigError, DataError
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through


@pytest.fixture(scope="module")
def bay(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Cameras]:
    folder = tmp_path_factory.mktemp("bay")
    return folder / "data", town_records(folder / "data")


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def test_the_scene_is_what_was_written(bay: tuple[Path, Cameras]) -> None:
    folder, truth = bay
    assert recognise(folder) == BlockNerfConfig()
    scene = parse_scene(folder, 1, None)
    assert len(scene.paths) == 16 and len(scene.train) == 12 and len(scene.test) == 4
    assert scene.exposure is not None
    # Names: camera by camera, in the order of the hashes.
    number = [(2**64 - int(path.stem.split("-")[1], 16)) // 7919 - 1 for path in scene.paths]
    assert sorted(number) == list(range(16))
    for view, k in enumerate(number):
        assert scene.paths[view].stem.startswith(f"cam{k % 2:02d}-")
        assert float(scene.exposure[view]) == (0.5 if k % 2 else 1.0)
        assert (view in scene.test.tolist()) == (k % 4 == 3)
        grid = pixel_grid(truth, k)
        mine, own = (
            rays_through(cameras, torch.full((len(grid),), at), grid) for cameras, at in ((scene.cameras, view), (truth, k))
        )
        torch.testing.assert_close(mine[0], own[0], atol=1e-4, rtol=0)
        torch.testing.assert_close(mine[1], own[1], atol=2e-4, rtol=0)
        assert load_image(scene.paths[view]).shape == (24, 32, 3)


def test_a_complete_cache_is_not_read_again(bay: tuple[Path, Cameras], monkeypatch: pytest.MonkeyPatch) -> None:
    from fprf.datamanagers.parsers import blocknerf

    first = parse_scene(bay[0], 1, None)
    monkeypatch.setattr(blocknerf, "read_examples", lambda path: pytest.fail("read again"))
    again = parse_scene(bay[0], 2, None)
    assert again.paths == first.paths and again.cameras.size[0].tolist() == [16, 12]
    first.paths[3].unlink()
    monkeypatch.undo()
    os.environ["XDG_CACHE_HOME"] = str(first.paths[0].parents[3])
    assert parse_scene(bay[0], 1, None).paths[3].is_file()


def test_some_cameras(bay: tuple[Path, Cameras]) -> None:
    scene = parse_scene(bay[0], 1, BlockNerfConfig(cameras=(1,)))
    assert len(scene.paths) == 8 and all(path.stem.startswith("cam01") for path in scene.paths)
    with pytest.raises(DataError, match=r"no images of cameras \[7\]; parser.cameras may name \[0, 1\]"):
        parse_scene(bay[0], 1, BlockNerfConfig(cameras=(7,)))
    with pytest.raises(ConfigError, match=r"parser.cameras"):
        BlockNerfConfig(cameras=(-1,))


def test_rays_of_no_camera_are_refused_unless_told(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    town_records(folder, views=4)
    features = good_features()
    rays = np.asarray(features["ray_dirs"]).reshape(24, 32, 3) + np.random.default_rng(0).normal(0, 0.1, (24, 32, 3))
    (folder / "odd_train.tfrecord").write_bytes(record(example(features | {"ray_dirs": rays.astype(np.float32).reshape(-1)})))
    with pytest.raises(DataError, match=r"the rays of cam05-0000000000000063 are .* pixels .*parser.tolerance is 1"):
        parse_scene(folder, 1, None)
    assert len(parse_scene(folder, 1, BlockNerfConfig(tolerance=50)).paths) == 5


def good_features() -> dict[str, bytes | list[int] | np.ndarray]:
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5)
    rays = np.stack([(x - 16) / 30, -(y - 12) / 30, -np.ones_like(x)], -1).astype(np.float32)
    done, image = cv2.imencode(".png", np.full((24, 32, 3), 90, np.uint8))
    assert done
    return {
        "image": image.tobytes(),
        "image_hash": [99],
        "cam_idx": [5],
        "height": [24],
        "width": [32],
        "equivalent_exposure": np.array([1.0], np.float32),
        "ray_origins": np.zeros(24 * 32 * 3, np.float32),
        "ray_dirs": rays.reshape(-1),
    }


@pytest.mark.parametrize(
    "change, said",
    [
        ({"height": [25]}, "ray_origins holds 2304 float32, 2400 finite floats"),
        ({"height": [2]}, "an image of 32x2 pixels"),
        ({"ray_dirs": np.zeros(24 * 32 * 3, np.float32)}, "its rays are not those of a camera"),
        ({"equivalent_exposure": np.array([0.0], np.float32)}, "equivalent_exposure is 0.0"),
        ({"image": [1]}, "image holds 1 int64, one byte string"),
        ({"cam_idx": b"x"}, "cam_idx holds 1 byte strings"),
    ],
)
def test_records_that_cannot_be_are_named(tmp_path: Path, change: dict[str, object], said: str) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "a_train.tfrecord").write_bytes(record(example(good_features() | change)))  # type: ignore[arg-type]
    with pytest.raises(DataError, match=said) as caught:
        parse_scene(folder, 1, None)
    assert "a_train.tfrecord: record 0" in str(caught.value)


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    done, image = cv2.imencode(".png", np.full((12, 12, 3), 90, np.uint8))
    assert done
    (folder / "a.tfrecord").write_bytes(record(example(good_features() | {"image": image.tobytes()})))
    with pytest.raises(DataError, match="12x12 pixels, but its camera has 32x24"):
        parse_scene(folder, 1, None)


def test_no_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no \*\.tfrecord files"):
        parse_scene(tmp_path, 1, BlockNerfConfig())


def test_it_trains_in_blocks_from_end_to_end(bay: tuple[Path, Cameras], tmp_path: Path) -> None:
    from fprf.cli.train import train_scene
    from fprf.config import StatisticsConfig
    from fprf.datamanagers.config import RayBatchesConfig
    from fprf.fields.config import PlanesConfig
    from fprf.fields.layouts import StreetConfig
    from fprf.methods import fprf_lite
    from fprf.training.loading import load_run
    from fprf.training.views import render_view

    lite = fprf_lite()
    config = replace(
        lite,
        data=bay[0],
        output=tmp_path / "run",
        steps=8,
        device="cpu",
        blocks=StreetConfig(segments=2),
        datamanager=RayBatchesConfig(rays=128, semantic_share=0.5),
        content=replace(lite.content, field=PlanesConfig(resolutions=(8,), channels=8, hidden=16, layers=1)),
        statistics=StatisticsConfig(rays=256, regions=3),
    )
    train_scene(config, "fprf-lite", quiet=True)
    trained = load_run(tmp_path / "run", "cpu")
    assert json.loads((tmp_path / "run/blocks.json").read_text())["rays"]
    image = render_view(trained.model, trained.known.facts, trained.known.cameras, 0, config.render).rgb
    assert image.shape == (24, 32, 3) and bool(torch.isfinite(image).all()) and float(image.std()) > 0
