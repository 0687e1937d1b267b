"""LLFF captures."""

from pathlib import Path

import numpy as np
import pytest
from capture_files import Capture, write_image, write_llff
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fprf.datamanagers.parsers.config import LlffConfig
from fprf.errors import DataError

FUZZ = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def test_poses_are_turned_and_intrinsics_belong_to_the_images(tmp_path: Path) -> None:
    capture = Capture.make()
    write_llff(tmp_path, capture, images="images_4", factor=4)
    scene = LlffConfig().build().parse(tmp_path, 1)
    assert np.allclose(scene.cameras.pose.numpy(), capture.poses, atol=1e-14)
    assert scene.cameras.focal[0].tolist() == [20.0, 20.0] and scene.cameras.centre[0].tolist() == [12.0, 8.0]
    assert scene.cameras.size[0].tolist() == [24, 16]
    assert scene.depths is not None and scene.depths[0].tolist() == [2.0, 9.0]
    assert [path.name for path in scene.paths] == list(capture.names) and scene.test.tolist() == [0, 8]


def test_the_folder_is_images_else_the_least_reduced_else_as_told(tmp_path: Path) -> None:
    capture = Capture.make(3)
    for name in ("images_8", "images_16"):
        write_llff(tmp_path, capture, images=name)
    (tmp_path / "images_2.zip").touch()
    assert LlffConfig().build().parse(tmp_path, 1).paths[0].parent.name == "images_8"
    write_llff(tmp_path, capture, images="images")
    assert LlffConfig().build().parse(tmp_path, 1).paths[0].parent.name == "images"
    assert LlffConfig(images="images_16").build().parse(tmp_path, 2).paths[0].parent.name == "images_16"
    with pytest.raises(DataError, match="leaves"):
        LlffConfig(images="../elsewhere").build().parse(tmp_path, 1)


def refuse(folder: Path, finding: str) -> None:
    with pytest.raises(DataError, match=finding) as caught:
        LlffConfig().build().parse(folder, 1)
    assert "\n" not in str(caught.value)


def test_images_and_poses_must_be_as_many(tmp_path: Path) -> None:
    write_llff(tmp_path, Capture.make(11))
    write_image(tmp_path / "images" / "extra.png", (24, 16))
    refuse(tmp_path, "12 images but 11 poses")


def test_no_image_folder_and_an_empty_one(tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.zeros((3, 17)))
    refuse(tmp_path, "no folder images or images_N")
    (tmp_path / "images").mkdir()
    refuse(tmp_path, "no image among 0 files")


@pytest.mark.parametrize(
    ("column", "value", "finding"),
    [
        (0, np.nan, "row 2 is not finite"),
        (15, np.inf, "row 2 is not finite"),
        (1, 3.0, r"row 2 \(0002.png\): the pose holds no rotation"),
        (4, 0.0, "row 2 says 24x0 pixels"),
        (9, 1e30, "row 2 says 1e"),
        (14, -5.0, "focal length"),
        (15, 10.0, "0 < near < far"),
        (9, 16.0, "but its camera has 16x16"),
    ],
)
def test_bad_rows_are_named(tmp_path: Path, column: int, value: float, finding: str) -> None:
    rows = write_llff(tmp_path, Capture.make(4))
    rows[2, column] = value
    np.save(tmp_path / "poses_bounds.npy", rows)
    refuse(tmp_path, finding)


@pytest.mark.parametrize("shape", [(0, 17), (4, 15), (17,)])
def test_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.zeros(shape))
    refuse(tmp_path, "one row of 17 numbers")


@FUZZ
@given(st.data())
def test_any_bytes_are_a_scene_or_a_data_error(tmp_path: Path, data: st.DataObject) -> None:
    if not (tmp_path / "images").exists():
        write_llff(tmp_path, Capture.make(2))
        (tmp_path / "whole").write_bytes((tmp_path / "poses_bounds.npy").read_bytes())
    content = bytearray((tmp_path / "whole").read_bytes())
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "poses_bounds.npy").write_bytes(content[: data.draw(st.integers(len(content) - 4, len(content)))])
    try:
        LlffConfig().build().parse(tmp_path, 1)
    except DataError:
        return
