"""LLFF captures."""

from pathlib import Path

import numpy as np
import pytest
from capture_files import Capture, write_llff

from fprf.datamanagers.parsers.config import LlffConfig
from fprf.errors import DataError


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
