"""Nerfstudio, instant-ngp and Blender JSON."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from capture_files import Capture, write_image, write_transforms

from fprf.datamanagers.parsers.config import TransformsConfig
from fprf.datamanagers.scene import Scene
from fprf.errors import DataError


def parse(folder: Path, downscale: int = 1, file: str = "") -> Scene:
    return TransformsConfig(file=file).build().parse(folder, downscale)


def edit(folder: Path, content: dict[str, object], **changes: object) -> None:
    (folder / "transforms.json").write_text(json.dumps({**content, **changes}))


def test_global_and_per_frame_intrinsics_are_the_same(tmp_path: Path) -> None:
    capture = Capture.make(focal=(20.0, 21.0), k=(0.05, -0.02, 0.001, -0.002))
    write_transforms(tmp_path / "a", capture)
    write_transforms(tmp_path / "b", capture, per_frame=True)
    one, other = parse(tmp_path / "a"), parse(tmp_path / "b")
    for field in ("pose", "focal", "centre", "size", "distortion", "lens"):
        assert getattr(one.cameras, field).tolist() == getattr(other.cameras, field).tolist()
    assert np.allclose(one.cameras.pose.numpy(), capture.poses, atol=1e-14)
    assert one.cameras.distortion[0].tolist() == [0.05, -0.02, 0.0, 0.0, 0.001, -0.002]
    assert one.cameras.lens.unique().tolist() == [1]
    assert one.points is not None and np.allclose(one.points.numpy(), capture.points, atol=1e-6)
    assert one.depths is None and one.test.tolist() == [0, 8]


@pytest.mark.parametrize(
    ("camera", "lens", "distortion"),
    [
        ({}, 0, [0.0] * 6),
        ({"camera_model": "PINHOLE"}, 0, [0.0] * 6),
        ({"camera_model": "OPENCV"}, 0, [0.0] * 6),
        ({"camera_model": "OPENCV", "k3": 0.1, "k4": 0.2}, 1, [0.0, 0.0, 0.1, 0.2, 0.0, 0.0]),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1}, 2, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]),
        ({"is_fisheye": True}, 2, [0.0] * 6),
        ({"k1": None}, 0, [0.0] * 6),
    ],
)
def test_lenses(tmp_path: Path, camera: dict[str, object], lens: int, distortion: list[float]) -> None:
    write_transforms(tmp_path, Capture.make(2), **camera)
    cameras = parse(tmp_path).cameras
    assert cameras.lens.tolist() == [lens] * 2 and cameras.distortion[0].tolist() == distortion


def test_what_is_left_out_follows_from_the_image(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, Capture.make(2))
    for key in ("w", "h", "cx", "cy", "fl_x", "fl_y"):
        del content[key]
    edit(tmp_path, content, camera_angle_x=math.pi / 2)
    cameras = parse(tmp_path).cameras
    assert cameras.size[0].tolist() == [24, 16] and cameras.centre[0].tolist() == [12.0, 8.0]
    assert cameras.focal[0].tolist() == pytest.approx([12.0, 12.0])
    edit(tmp_path, content, fl_x=30.0)
    assert parse(tmp_path).cameras.focal[0].tolist() == [30.0, 30.0]
    edit(tmp_path, content, fl_x=30.0, camera_angle_y=math.pi / 2)
    assert parse(tmp_path).cameras.focal[0].tolist() == pytest.approx([30.0, 8.0])


def blender(folder: Path, part: str, count: int) -> None:
    frames = []
    for k in range(count):
        write_image(folder / part / f"r_{k}.png", (10, 10), channels=4, seed=k)
        frames.append({"file_path": f"./{part}/r_{k}", "transform_matrix": np.eye(4).tolist(), "rotation": 0.1})
    (folder / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": 0.6911, "frames": frames}))


def test_blender_s_two_files(tmp_path: Path) -> None:
    blender(tmp_path, "train", 4)
    blender(tmp_path, "test", 2)
    scene = parse(tmp_path)
    assert scene.alpha and len(scene.paths) == 6
    assert {scene.paths[k].parent.name for k in scene.train} == {"train"} and len(scene.train) == 4
    assert {scene.paths[k].parent.name for k in scene.test} == {"test"} and len(scene.test) == 2
    assert scene.cameras.focal[0, 0].item() == pytest.approx(5 / math.tan(0.6911 / 2))


@pytest.mark.parametrize(
    ("lists", "train", "test"),
    [
        ({"train_filenames": ["images/0001.png"], "test_filenames": ["images/0003.png"]}, [1], [3]),
        ({"train_filenames": ["./images/0001.png"]}, [1], [0, 2, 3]),
        ({"train_filenames": ["images/0001.png"], "val_filenames": ["images/0000.png"]}, [1], [2, 3]),
        ({"test_filenames": ["images/0000.png", "images/0002.png"]}, [1, 3], [0, 2]),
    ],
)
def test_the_capture_says_what_is_held_out(tmp_path: Path, lists: dict[str, object], train: list[int], test: list[int]) -> None:
    write_transforms(tmp_path, Capture.make(4), **lists)
    scene = parse(tmp_path)
    assert scene.train.tolist() == train and scene.test.tolist() == test


def test_points_of_another_shape_are_refused_and_infinite_ones_dropped(tmp_path: Path) -> None:
    write_transforms(tmp_path, Capture.make(2))
    np.savez(tmp_path / "points.npz", xyz=np.array([[0, 0, 1], [np.inf, 0, 0], [np.nan, 0, 0]]))
    points = parse(tmp_path).points
    assert points is not None and points.tolist() == [[0.0, 0.0, 1.0]]
    np.savez(tmp_path / "points.npz", xyz=np.zeros((4, 2)))
    with pytest.raises(DataError, match=r"\(4, 2\), not \[P 3\]"):
        parse(tmp_path)
