"""COLMAP models, binary and text."""

import struct
from pathlib import Path

import numpy as np
import pytest
from capture_files import Capture, write_colmap

from fprf.datamanagers.parsers.colmap import MODELS, model_folder
from fprf.datamanagers.parsers.config import ColmapConfig
from fprf.datamanagers.scene import Scene
from fprf.errors import DataError

ID = {name: index for index, (name, _) in enumerate(MODELS)}


def parse(folder: Path, images: str = "images", downscale: int = 1) -> Scene:
    return ColmapConfig(images=images).build().parse(folder, downscale)


@pytest.mark.parametrize("binary", [True, False])
def test_a_model_is_the_capture(tmp_path: Path, binary: bool) -> None:
    capture = Capture.make(focal=(20.0, 21.0))
    write_colmap(tmp_path, capture, binary=binary)
    scene = parse(tmp_path)
    assert np.allclose(scene.cameras.pose.numpy(), capture.poses, atol=1e-14)
    assert scene.cameras.focal[0].tolist() == [20.0, 21.0] and scene.cameras.centre[0].tolist() == [12.0, 8.0]
    assert scene.cameras.lens.unique().tolist() == [0] and scene.test.tolist() == [0, 8]
    assert scene.points is not None and np.array_equal(scene.points.numpy(), capture.points)
    depth = (capture.points - capture.poses[3, :, 3]) @ -capture.poses[3, :, 2]
    assert scene.depths is not None
    assert scene.depths[3].tolist() == pytest.approx(np.percentile(depth, (0.1, 99.9)).tolist(), rel=1e-12)


@pytest.mark.parametrize(
    ("model", "params", "lens", "distortion"),
    [
        ("SIMPLE_PINHOLE", (20, 12, 8), 0, (0, 0, 0, 0, 0, 0)),
        ("PINHOLE", (20, 20, 12, 8), 0, (0, 0, 0, 0, 0, 0)),
        ("SIMPLE_RADIAL", (20, 12, 8, 0.1), 1, (0.1, 0, 0, 0, 0, 0)),
        ("SIMPLE_RADIAL", (20, 12, 8, 0), 0, (0, 0, 0, 0, 0, 0)),
        ("RADIAL", (20, 12, 8, 0.1, 0.2), 1, (0.1, 0.2, 0, 0, 0, 0)),
        ("OPENCV", (20, 20, 12, 8, 0.1, 0.2, 0.3, 0.4), 1, (0.1, 0.2, 0, 0, 0.3, 0.4)),
        ("FULL_OPENCV", (20, 20, 12, 8, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0), 1, (0.1, 0.2, 0.5, 0, 0.3, 0.4)),
        ("OPENCV_FISHEYE", (20, 20, 12, 8, 0.1, 0.2, 0.3, 0.4), 2, (0.1, 0.2, 0.3, 0.4, 0, 0)),
        ("SIMPLE_RADIAL_FISHEYE", (20, 12, 8, 0.1), 2, (0.1, 0, 0, 0, 0, 0)),
        ("RADIAL_FISHEYE", (20, 12, 8, 0.1, 0.2), 2, (0.1, 0.2, 0, 0, 0, 0)),
    ],
)
@pytest.mark.parametrize("binary", [True, False])
def test_lenses(
    tmp_path: Path, model: str, params: tuple[float, ...], lens: int, distortion: tuple[float, ...], binary: bool
) -> None:
    write_colmap(tmp_path, Capture.make(2), binary=binary, model=(ID[model], model), params=params)
    cameras = parse(tmp_path).cameras
    assert cameras.focal[0].tolist() == [20, 20] and cameras.centre[0].tolist() == [12, 8]
    assert cameras.lens[0].item() == lens and cameras.distortion[0].tolist() == list(distortion)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("FULL_OPENCV", (20, 20, 12, 8, 0, 0, 0, 0, 0, 0.1, 0, 0)),
        ("FOV", (20, 20, 12, 8, 0.9)),
        ("THIN_PRISM_FISHEYE", (20.0,) * 12),
    ],
)
def test_other_lenses_are_refused_with_a_remedy(tmp_path: Path, model: str, params: tuple[float, ...]) -> None:
    write_colmap(tmp_path, Capture.make(2), model=(ID[model], model), params=params)
    with pytest.raises(DataError, match=f"the lens {model} .*image_undistorter"):
        parse(tmp_path)


def test_models_are_found_in_three_places(tmp_path: Path) -> None:
    sparse = write_colmap(tmp_path, Capture.make(2))
    assert model_folder(tmp_path) == sparse
    for place in (tmp_path / "sparse", tmp_path):
        for file in list(sparse.iterdir()):
            file.rename(place / file.name)
        sparse = place
        assert model_folder(tmp_path) == place and len(parse(tmp_path).paths) == 2
    (tmp_path / "cameras.bin").unlink()
    assert model_folder(tmp_path) is None
    with pytest.raises(DataError, match=r"no cameras\.bin or cameras\.txt"):
        parse(tmp_path)


def test_reduced_images_must_be_named(tmp_path: Path) -> None:
    small = Capture.make(2, size=(12, 8), focal=(10.0, 10.0))
    write_colmap(tmp_path, small, images="images_2", model=(1, "PINHOLE"), params=(10.0, 10.0, 6.0, 4.0))
    path = tmp_path / "sparse" / "0" / "cameras.bin"
    path.write_bytes(struct.pack("<QIiQQ4d", 1, 7, 1, 24, 16, 20.0, 20.0, 12.0, 8.0))
    cameras = parse(tmp_path, "images_2").cameras
    assert cameras.size[0].tolist() == [12, 8] and cameras.focal[0].tolist() == [10.0, 10.0]
    (tmp_path / "images_2").rename(tmp_path / "images")
    with pytest.raises(DataError, match="12x8 pixels, but its camera has 24x16"):
        parse(tmp_path)


def test_points_are_optional(tmp_path: Path) -> None:
    for binary, suffix in ((True, "bin"), (False, "txt")):
        sparse = write_colmap(tmp_path / suffix, Capture.make(2), binary=binary)
        (sparse / f"points3D.{suffix}").unlink()
        scene = parse(tmp_path / suffix)
        assert scene.points is None and scene.depths is None
