import base64
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError, NumericsError
from fprf.io.images import data_uri, encode, shrink, to_uint8, write_image


def ramp(height: int = 40, width: int = 60) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // max(1, width - 1), y * 255 // max(1, height - 1), x * 0 + 40], -1).astype(np.uint8)


def read(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def test_every_8_bit_step_survives_the_trip_through_floats() -> None:
    steps = torch.arange(256, dtype=torch.uint8).reshape(16, 16, 1).expand(16, 16, 3)
    for kind in (torch.float32, torch.float64):
        assert np.array_equal(to_uint8(steps.to(kind) / 255), steps.numpy())


def test_floats_are_clipped_and_rounded_to_the_nearest() -> None:
    found = to_uint8(torch.tensor([[[-1.0, 2.0, 0.49 / 255], [0.51 / 255, 254.4 / 255, 254.6 / 255]]]))
    assert found.tolist() == [[[0, 255, 0], [1, 254, 255]]]


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
    with pytest.raises(DataError, match=r"'\.tiff' is no picture format; allowed are \.png"):
        write_image(tmp_path / "a.tiff", ramp())
    for wrong in (ramp().astype(np.float32), ramp()[..., 0], np.zeros((0, 4, 3), np.uint8), np.zeros((4, 4, 4), np.uint8)):
        with pytest.raises(DataError, match="uint8 of shape"):
            encode(wrong, "png")
    with pytest.raises(DataError, match="use png"):
        encode(np.zeros((1, 20000, 3), np.uint8), "webp")


def test_a_data_uri_holds_the_picture() -> None:
    kind, data = data_uri(ramp(), "png").split(",")
    assert kind == "data:image/png;base64"
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), ramp())


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 80))
def test_shrinking_keeps_the_shape_and_the_mean(height: int, width: int, side: int) -> None:
    picture = ramp(height, width)
    small = shrink(picture, side)
    assert max(small.shape[:2]) == min(side, max(height, width))
    assert small.min() >= picture.min() and small.max() <= picture.max()
    if min(small.shape[:2]) > 8:
        assert np.abs(small.mean((0, 1)) - picture.mean((0, 1))).max() < 3
