"""Captures of Polycam, Record3D and OpenDroneMap: the same rays as the same capture in transforms.json."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import Capture, write_image, write_odm, write_polycam, write_record3d, write_transforms

from fprf.datamanagers.parsers.config import OdmConfig, PolycamConfig, Record3DConfig, parse_scene, recognise
from fprf.datamanagers.scene import Scene
from fprf.errors import ConfigError, DataError
from fprf.rendering.cameras import project


def wanted(folder: Path, capture: Capture) -> Scene:
    write_transforms(folder / "transforms", capture)
    return parse_scene(folder / "transforms", 1, None)


def assert_same(found: Scene, other: Scene, tolerance: float = 1e-9) -> None:
    assert len(found.paths) == len(other.paths) and torch.equal(found.test, other.test)
    for field in ("pose", "focal", "centre", "distortion"):
        assert torch.allclose(getattr(found.cameras, field), getattr(other.cameras, field), atol=tolerance), field
    assert found.cameras.size.tolist() == other.cameras.size.tolist()
    assert found.cameras.lens.tolist() == other.cameras.lens.tolist()


@pytest.mark.parametrize("corrected", [False, True])
@pytest.mark.parametrize("inner", ["keyframes", "."])
def test_polycam(tmp_path: Path, corrected: bool, inner: str) -> None:
    capture = Capture.make(9, focal=(20.0, 21.0))
    write_polycam(tmp_path / "p" / inner, capture, corrected=corrected)
    assert recognise(tmp_path / "p") == PolycamConfig()
    assert_same(parse_scene(tmp_path / "p", 1, None), wanted(tmp_path, capture))


def test_polycam_s_images_without_a_camera_are_left_out(tmp_path: Path) -> None:
    cameras = write_polycam(tmp_path / "keyframes", Capture.make(5))
    (cameras / "0002.json").unlink()
    assert [path.name for path in parse_scene(tmp_path, 1, None).paths] == ["0000.png", "0001.png", "0003.png", "0004.png"]
    for file in cameras.iterdir():
        file.rename(file.with_name(f"x{file.name}"))
    with pytest.raises(DataError, match="has the name of an image"):
        parse_scene(tmp_path, 1, None)


@pytest.mark.parametrize("packed", [False, True])
def test_record3d(tmp_path: Path, packed: bool) -> None:
    capture = Capture.make(9, focal=(20.0, 21.0))
    write_record3d(tmp_path / "r", capture, packed=packed)
    assert recognise(tmp_path / "r") == Record3DConfig()
    assert_same(parse_scene(tmp_path / "r", 1, None), wanted(tmp_path, capture))


def test_record3d_s_images_go_by_their_numbers(tmp_path: Path) -> None:
    capture = Capture.make(12)
    write_record3d(tmp_path, capture)
    found = parse_scene(tmp_path, 1, None)
    assert [path.stem for path in found.paths] == [str(k) for k in range(12)]
    assert np.allclose(found.cameras.pose.numpy(), capture.poses, atol=1e-9)
    few = Record3DConfig(frames=4).build().parse(tmp_path, 1)
    assert [path.stem for path in few.paths] == ["0", "4", "7", "11"]
    assert np.allclose(few.cameras.pose.numpy(), capture.poses[[0, 4, 7, 11]], atol=1e-9)
    with pytest.raises(ConfigError):
        Record3DConfig(frames=0)


def test_record3d_s_lenses_may_change_from_image_to_image(tmp_path: Path) -> None:
    rows = [[20.0 + k, 21.0 + k, 11.0, 9.0] for k in range(3)]
    write_record3d(tmp_path, Capture.make(3), perFrameIntrinsicCoeffs=rows)
    cameras = parse_scene(tmp_path, 1, None).cameras
    assert torch.cat([cameras.focal, cameras.centre], 1).tolist() == rows


@pytest.mark.parametrize("report", [False, True])
def test_odm(tmp_path: Path, report: bool) -> None:
    capture = Capture.make(9, focal=(20.0, 21.0), k=(0.05, -0.02, 0.001, -0.002))
    write_odm(tmp_path / "o", capture, report=report)
    assert recognise(tmp_path / "o") == OdmConfig()
    found = parse_scene(tmp_path / "o", 1, None)
    assert_same(found, wanted(tmp_path, capture))
    assert report == (found.points is None)
    if found.points is not None:
        assert np.allclose(found.points.numpy(), capture.points)
        pixel, depth = project(found.cameras, torch.zeros(40, dtype=torch.int64), found.points)
        assert bool((depth > 0).all()) and bool(pixel.isfinite().all())


@pytest.mark.parametrize(
    ("camera", "lens", "distortion"),
    [
        ({"projection_type": "perspective", "focal": 0.9, "k1": 0.1, "k2": 0.2}, 1, [0.1, 0.2, 0, 0, 0, 0]),
        ({"projection_type": "perspective", "focal": 0.9}, 0, [0.0] * 6),
        ({"projection_type": "fisheye", "k1": 0.1}, 2, [0.1, 0, 0, 0, 0, 0]),
        ({"projection_type": "fisheye_opencv"}, 2, [0.0] * 6),
        ({"k3": 0.3}, 1, [0, 0, 0.3, 0, 0, 0]),
    ],
)
def test_odm_s_lenses(tmp_path: Path, camera: dict[str, object], lens: int, distortion: list[float]) -> None:
    write_odm(tmp_path, Capture.make(2), **camera)
    cameras = parse_scene(tmp_path, 1, None).cameras
    assert cameras.lens.tolist() == [lens] * 2 and cameras.distortion[0].tolist() == distortion


def test_odm_s_images_stay_inside_and_missing_ones_are_named(tmp_path: Path) -> None:
    file = write_odm(tmp_path, Capture.make(2))
    whole = json.loads(file.read_text())
    whole[0]["shots"]["../x.png"] = whole[0]["shots"]["0001.png"]
    file.write_text(json.dumps(whole))
    with pytest.raises(DataError, match="leaves"):
        parse_scene(tmp_path, 1, None)
    del whole[0]["shots"]["../x.png"]
    file.write_text(json.dumps(whole))
    (tmp_path / "images" / "0001.png").unlink()
    with pytest.raises(DataError, match="1 of 2 images are missing"):
        parse_scene(tmp_path, 1, None)
    write_image(tmp_path / "photos" / "0000.png", (24, 16))
    write_image(tmp_path / "photos" / "0001.png", (24, 16))
    assert len(OdmConfig(images="photos").build().parse(tmp_path, 1).paths) == 2
