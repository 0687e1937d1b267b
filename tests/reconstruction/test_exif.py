import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.reconstruction.images import Lens, lens_of, read_lens


def tiff(order: str, model: bytes = b"Phone 9\0", focal: tuple[int, int] = (425, 100), short: int = 26) -> bytes:
    """Header, a directory with the model and the inner directory, the inner one, and the values that don't fit."""
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 8)
    inner_at, model_at = 8 + 2 + 2 * 12 + 4, 8 + 2 + 2 * 12 + 4 + 2 + 2 * 12 + 4
    first = struct.pack(order + "H", 2) + struct.pack(order + "HHII", 0x0110, 2, len(model), model_at)
    first += struct.pack(order + "HHII", 0x8769, 4, 1, inner_at) + struct.pack(order + "I", 0)
    inner = struct.pack(order + "H", 2) + struct.pack(order + "HHII", 0x920A, 5, 1, model_at + len(model))
    inner += struct.pack(order + "HHIHH", 0xA405, 3, 1, short, 0) + struct.pack(order + "I", 0)
    return head + first + inner + model + struct.pack(order + "II", *focal)


JPEG = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()


def with_exif(block: bytes) -> bytes:
    return JPEG[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 8) + b"Exif\0\0" + block + JPEG[2:]


def photo(path: Path, block: bytes | None) -> Path:
    path.write_bytes(JPEG if block is None else with_exif(block))
    return path


@pytest.mark.parametrize("order", ["<", ">"])
def test_model_and_focal_length_in_both_byte_orders(order: str, tmp_path: Path) -> None:
    path = photo(tmp_path / "a.jpg", tiff(order))
    assert read_lens(path) == Lens("Phone 9", 4.25, 26)
    assert cv2.imread(str(path)).shape == (8, 8, 3), "still a photograph"


def test_lenses_tell_cameras_apart(tmp_path: Path) -> None:
    wide, tele = (read_lens(photo(tmp_path / f"{f}.jpg", tiff("<", focal=(f, 100), short=f // 10))) for f in (220, 700))
    assert wide != tele and wide.model == tele.model
    assert read_lens(photo(tmp_path / "x.jpg", tiff("<", focal=(1, 0)))).focal == 0


def test_files_that_say_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(50))
    assert read_lens(tmp_path / "a.png") == read_lens(photo(tmp_path / "a.jpg", None)) == read_lens(tmp_path / "gone") == Lens()


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_no_damage_makes_it_fail(noise: bytes) -> None:
    whole = tiff("<")
    for block in (noise, whole[: len(noise)], whole[:20] + noise, whole[:8] + noise + whole[8:]):
        assert isinstance(lens_of(with_exif(block)), Lens)
    assert isinstance(lens_of(noise), Lens) and lens_of(b"") == Lens()
