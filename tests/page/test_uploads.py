import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from photo_files import HEIC, turned_jpeg

from fprf.errors import DataError
from fprf.page.uploads import MAX_BYTES, MAX_SIDE, Uploads, check_photograph, shown_name


def png(width: int, height: int) -> bytes:
    drawn = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return bytes(cv2.imencode(".png", drawn)[1].tobytes())


def claimed(width: int, height: int) -> bytes:
    """The head of a PNG that says it is so large, and ends."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


@pytest.fixture(scope="module")
def uploaded() -> Iterator[Uploads]:
    with closing(Uploads(timeout=120)) as found:
        yield found


def test_a_photograph_becomes_a_png_of_ours(uploaded: Uploads) -> None:
    path = uploaded.store(png(60, 40))
    assert path.parent == uploaded.folder and path.suffix == ".png"
    assert cv2.imread(str(path)).shape == (40, 60, 3)
    large = uploaded.store(png(MAX_SIDE * 2, 100))
    assert cv2.imread(str(large)).shape == (50, MAX_SIDE, 3)
    assert sorted(uploaded.folder.glob("*.part")) == []


def test_photographs_of_phones_come_upright(uploaded: Uploads, tmp_path: Path) -> None:
    shown = turned_jpeg(tmp_path / "a.jpg", cv2.imdecode(np.frombuffer(png(60, 40), np.uint8), cv2.IMREAD_COLOR), 6)
    assert np.array_equal(cv2.imread(str(uploaded.store((tmp_path / "a.jpg").read_bytes())))[:, :, ::-1], shown)
    pytest.importorskip("pillow_heif")
    assert cv2.imread(str(uploaded.store(HEIC))).shape == (64, 48, 3)


def test_a_photograph_is_refused_by_its_first_bytes_before_anything_is_decoded(uploaded: Uploads) -> None:
    with pytest.raises(DataError, match="100000x100000 pixels"):
        uploaded.store(claimed(100_000, 100_000) + png(2, 2)[33:])
    for data, said in (
        (b"", "no PNG"),
        (b"GIF89a" + b"x" * 100, "no PNG"),
        (b"\x89PNG\r\n\x1a\n" + b"x" * (MAX_BYTES + 1), f"at most {MAX_BYTES}"),
    ):
        with pytest.raises(DataError, match=said):
            check_photograph(data)


@pytest.mark.parametrize(
    "data", [claimed(30, 20), claimed(0, 10), png(30, 20)[:-40], b"\xff\xd8\xff" + b"\xc0\0\x0b\x08\0\x10\0\x10" + b"\0" * 40]
)
def test_damaged_ones_are_told_and_the_next_one_goes(uploaded: Uploads, data: bytes) -> None:
    with pytest.raises(DataError, match="photograph: ") as told:
        uploaded.store(data)
    assert str(uploaded.folder) not in str(told.value)
    assert uploaded.store(png(20, 20)).is_file()


def test_a_decoder_that_died_is_replaced(uploaded: Uploads) -> None:
    uploaded.store(png(20, 20))
    process = uploaded._process
    process.kill()
    process.join()
    assert uploaded.store(png(20, 20)).is_file() and uploaded._process is not process


def test_one_that_takes_too_long_is_ended() -> None:
    with closing(Uploads(timeout=0.0)) as hasty, pytest.raises(DataError, match="not decoded within"):
        hasty.store(png(20, 20))
    assert not hasty.folder.exists()


@pytest.mark.skipif(os.name != "posix", reason="limits are a matter of Unix")
def test_memory_beyond_the_room_is_refused() -> None:
    greedy = "import numpy; from fprf.page import uploads; uploads.limit_memory(64 << 20); numpy.ones(256 << 20, numpy.uint8)"
    ended = subprocess.run([sys.executable, "-c", greedy], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 1 and "MemoryError" in ended.stderr


def test_names_are_shown_plain_and_short() -> None:
    for given, shown in {
        "../../etc/passwd": "passwd",
        "C:\\photos\\a b.png": "a b.png",
        "<script>alert(1)</script>.png": "script_.png",
        "": "photograph",
        "line\nbreak\x00.png": "linebreak.png",
        "Übung-ñ.jpeg": "Übung-ñ.jpeg",
    }.items():
        assert shown_name(given) == shown
    found = shown_name("x" * 300 + ".jpg")
    assert len(found) <= 48 and found.endswith(".jpg") and "…" in found
