"""Image files of every kind, whole and damaged."""

import re
import struct
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import Capture, write_image, write_transforms
from photo_files import HEIC, turned_jpeg

from fprf.datamanagers.images import header_of, image_names, load_image, load_images, photographs, read_header
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import DataError


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(size: tuple[int, int], bits: int, colour: int, rows: list[bytes], extra: bytes = b"") -> bytes:
    """A PNG by hand, for kinds that OpenCV cannot write."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, bits, colour, 0, 0, 0))
    data = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows)))
    return b"\x89PNG\r\n\x1a\n" + head + extra + data + chunk(b"IEND", b"")


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


NOISE = np.random.default_rng(0).integers(0, 256, (12, 18, 3), dtype=np.uint8)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".bmp", ".tiff"])
def test_headers_tell_the_size_without_decoding(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / "wrong_extension.txt"
    path.write_bytes(encoded(suffix, NOISE))
    header = read_header(path)
    assert (header.width, header.height, header.alpha) == (18, 12, False)


def test_grey_palettes_and_straight_transparency_become_rgb(tmp_path: Path) -> None:
    kinds = {
        "grey": (png((3, 1), 8, 0, [bytes([0, 100, 255])]), [[0] * 3, [100] * 3, [255] * 3]),
        "bilevel": (png((3, 1), 1, 0, [b"\xa0"]), [[255] * 3, [0] * 3, [255] * 3]),
        "grey_alpha": (png((3, 1), 8, 4, [bytes([10, 255, 10, 0, 0, 255])]), [[10] * 3, [255] * 3, [0] * 3]),
        "palette": (
            png((3, 1), 8, 3, [bytes([0, 1, 0])], chunk(b"PLTE", bytes([1, 2, 3, 4, 5, 6])) + chunk(b"tRNS", b"\xff\x00")),
            [[1, 2, 3], [255] * 3, [1, 2, 3]],
        ),
        "alpha": (
            png((3, 1), 8, 6, [bytes([10, 20, 30, 255, 10, 20, 30, 0, 10, 20, 30, 51])]),
            [[10, 20, 30], [255] * 3, [206, 208, 210]],
        ),
    }
    for name, (data, expected) in kinds.items():
        (tmp_path / name).write_bytes(data)
        assert load_image(tmp_path / name).tolist() == [expected], name
    assert read_header(tmp_path / "palette").alpha and not read_header(tmp_path / "grey").alpha
    red = load_image(tmp_path / "alpha", background=(1.0, 0.0, 0.0))
    assert red.tolist() == [[[10, 20, 30], [255, 0, 0], [206, 4, 6]]]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_ignored_unless_a_photograph_is_wanted_upright(tmp_path: Path, orientation: int) -> None:
    shown = turned_jpeg(tmp_path / "a.jpg", NOISE, orientation)
    stored = turned_jpeg(tmp_path / "b.jpg", NOISE, 1)
    assert np.array_equal(load_image(tmp_path / "a.jpg"), stored)
    assert np.array_equal(load_image(tmp_path / "a.jpg", upright=True), shown)
    assert np.array_equal(load_image(tmp_path / "b.jpg", upright=True), stored)


def test_heic_comes_upright_and_needs_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.heic").write_bytes(HEIC)
    assert read_header(tmp_path / "a.heic") == (48, 64, False, "heic")
    for length in range(len(HEIC)):
        header_of(HEIC[:length])  # whatever is cut off, it is an answer and no fault
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        with pytest.raises(DataError, match=r"is HEIC.*pip install 'fprf\[heic\]', or convert"):
            load_image(tmp_path / "a.heic")
    pytest.importorskip("pillow_heif")
    for upright in (False, True):
        loaded = load_image(tmp_path / "a.heic", upright=upright).astype(int)
        assert loaded.shape == (64, 48, 3)
        for (y, x), colour in {(15, 24): (200, 40, 30), (50, 12): (20, 60, 220), (50, 36): (30, 180, 60)}.items():
            assert abs(loaded[y, x] - colour).max() < 8
    for damaged in (HEIC[:-40], HEIC[:452] + b"\x83" + HEIC[453:]):  # the second one without any image
        (tmp_path / "a.heic").write_bytes(damaged)
        with pytest.raises(DataError, match="cannot be decoded"):
            load_image(tmp_path / "a.heic")


def test_folders_of_photographs_are_listed_without_what_cannot_be_read(tmp_path: Path) -> None:
    for name in ("b.png", "a.jpg", "notes.txt", ".hidden.png", "broken.jpg", "empty.webp"):
        (tmp_path / name).write_bytes(encoded(".png" if "png" in name else ".jpg", NOISE))
    (tmp_path / "broken.jpg").write_bytes(b"not a photograph")
    (tmp_path / "empty.webp").write_bytes(b"")
    (tmp_path / "deeper").mkdir()
    told: list[str] = []
    found = photographs([tmp_path / "b.png", tmp_path, tmp_path / "broken.jpg"], told.append)
    assert [path.name for path in found] == ["b.png", "a.jpg", "broken.jpg"], "what is named by itself is taken as it is"
    assert len(told) == 2 and "broken.jpg" in told[0] and "empty.webp: the file is empty" in told[1]
    assert image_names(tmp_path) == ["a.jpg", "b.png", "broken.jpg", "empty.webp"]
    with pytest.raises(DataError, match="deeper: no image among 0 files"):
        photographs([tmp_path / "deeper"], told.append)
    with pytest.raises(DataError, match="no such image folder"):
        image_names(tmp_path / "absent")
    (tmp_path / "deeper" / "x.png").write_bytes(b"")
    with pytest.raises(DataError, match=r"none of its 1 images can be read.*x\.png"):
        photographs([tmp_path / "deeper"], told.append)


def test_reduction_averages_areas(tmp_path: Path) -> None:
    image = write_image(tmp_path / "a.png", (20, 12))[:, :, ::-1]
    small = load_image(tmp_path / "a.png", (5, 3)).astype(float)
    assert np.abs(small - image.reshape(3, 4, 5, 4, 3).mean((1, 3))).max() <= 0.5 + 1e-6
    assert load_image(tmp_path / "a.png", (40, 24)).shape == (24, 40, 3)


@pytest.mark.parametrize(
    ("content", "finding"),
    [
        (b"", "empty"),
        (b"no image at all", "no PNG, JPEG"),
        (png((20_000, 20_000), 8, 2, []), "20000x20000 pixels; at most 1e+08"),
        (png((0, 5), 8, 2, []), "0x5 pixels"),
        (encoded(".png", NOISE)[:-12], "truncated"),
        (encoded(".png", NOISE)[:200], "truncated"),
        (encoded(".jpg", NOISE)[:-2], "truncated"),
        (encoded(".jpg", NOISE)[:700], "truncated"),
        (encoded(".png", NOISE)[:100] + b"?" + encoded(".png", NOISE)[101:], "checksum"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, content: bytes, finding: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(DataError, match=re.escape(finding)) as caught:
        load_image(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_an_image_that_was_rotated_after_parsing_is_refused(tmp_path: Path) -> None:
    write_transforms(tmp_path, Capture.make(3))
    scene = parse_scene(tmp_path, 1, None)
    write_image(scene.paths[1], (16, 24))
    with pytest.raises(DataError, match="16x24 pixels do not fit its camera's 24x16"):
        load_images(scene)
