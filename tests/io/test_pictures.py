from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError, NumericsError
from fprf.io.images import encode, shrink, srgb_to_linear, to_uint8, write_image


def ramp(height: int = 40, width: int = 60) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // max(1, width - 1), y * 255 // max(1, height - 1), x * 0 + 40], -1).astype(np.uint8)


def read(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused(value: float) -> None:
    image = torch.zeros(2, 2, 3)
    image[0, 0, 0] = value
    with pytest.raises(NumericsError, match="not finite"):
        to_uint8(image)


def test_png_is_exact_and_the_others_are_close(tmp_path: Path) -> None:
    picture = ramp()
    for name, bound in (("a.png", 0), ("a.jpg", 12), ("a.JPEG", 12), ("a.webp", 14)):
        write_image(tmp_path / name, picture)
        assert np.abs(read(tmp_path / name).astype(int) - picture).max() <= bound, name


def test_other_endings_and_other_arrays_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError):
        write_image(tmp_path / "a.tiff", ramp())
    for wrong in (ramp().astype(np.float32), ramp()[..., 0], np.zeros((0, 4, 3), np.uint8), np.zeros((4, 4, 4), np.uint8)):
        with pytest.raises(DataError):
            encode(wrong, "png")
    with pytest.raises(DataError, match="use png"):
        encode(np.zeros((1, 20000, 3), np.uint8), "webp")
    assert not list(tmp_path.iterdir())


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 80))
def test_shrinking_keeps_the_shape_and_the_mean(height: int, width: int, side: int) -> None:
    picture = ramp(height, width)
    small = shrink(picture, side)
    assert max(small.shape[:2]) == min(side, max(height, width))
    assert small.min() >= picture.min() and small.max() <= picture.max()
    if min(small.shape[:2]) > 8:
        assert np.abs(small.mean((0, 1)) - picture.mean((0, 1))).max() < 3


def test_light_is_srgb_to_linear() -> None:
    assert srgb_to_linear(np.array([0.0, 0.04045, 0.5, 1.0], np.float32)) == pytest.approx(
        [0, 0.0031308, 0.2140411, 1], abs=1e-6
    )
