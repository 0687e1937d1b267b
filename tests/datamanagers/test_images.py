"""Image files of every kind, whole and damaged: the pixels that they give."""

import io
import re
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from capture_files import Capture, write_image, write_transforms
from photo_files import HEIC, oriented, turned_jpeg, upright
from PIL import Image, ImageCms

from fprf.datamanagers.image_files import read_header
from fprf.datamanagers.images import (
    image_names,
    load_image,
    load_images,
    load_mask,
    photographs,
    useless_masks,
)
from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import DataError


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(size: tuple[int, int], bits: int, colour: int, rows: list[bytes], extra: bytes = b"") -> bytes:
    """A PNG by hand, for kinds that no library writes."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, bits, colour, 0, 0, 0))
    data = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row for row in rows)))
    return b"\x89PNG\r\n\x1a\n" + head + extra + data + chunk(b"IEND", b"")


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


def saved(image: Image.Image, form: str, **options: object) -> bytes:
    out = io.BytesIO()
    image.copy().save(
        out, form, **options
    )  # Pillow keeps settings of the last format that an image was saved in
    return out.getvalue()


def quarters(height: int = 64, width: int = 96) -> np.ndarray:
    """Red, green, blue and yellow, each a quarter."""
    pixels = np.empty((height, width, 3), np.uint8)
    pixels[: height // 2, : width // 2], pixels[: height // 2, width // 2 :] = (200, 30, 40), (30, 180, 60)
    pixels[height // 2 :, : width // 2], pixels[height // 2 :, width // 2 :] = (40, 60, 210), (220, 200, 40)
    return pixels


NOISE = np.random.default_rng(0).integers(0, 256, (12, 18, 3), dtype=np.uint8)
COLOURS = quarters()
PICTURE = Image.fromarray(COLOURS)
GREY = np.asarray(PICTURE.convert("L"))
TURNED = PICTURE.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
SOUND = {"quality": 100, "subsampling": 0}
FINE = {"quality": 100, "subsampling": "4:4:4"}
KINDS: dict[str, tuple[bytes, np.ndarray, int]] = {
    "jpeg": (saved(PICTURE, "JPEG", **SOUND), COLOURS, 2),
    "progressive": (saved(PICTURE, "JPEG", progressive=True, **SOUND), COLOURS, 2),
    "trailing bytes": (saved(PICTURE, "JPEG", **SOUND) + b"\0" * 500, COLOURS, 2),
    "two pictures (MPO)": (
        saved(PICTURE, "MPO", save_all=True, append_images=[TURNED.copy()], **SOUND),
        COLOURS,
        2,
    ),
    "cmyk jpeg": (saved(PICTURE.convert("CMYK"), "JPEG", quality=100), COLOURS, 3),
    "grey jpeg": (saved(PICTURE.convert("L"), "JPEG", quality=100), GREY, 1),
    "cmyk tiff": (saved(PICTURE.convert("CMYK"), "TIFF"), COLOURS, 1),
    "cmyk tiff, packed": (saved(PICTURE.convert("CMYK"), "TIFF", compression="tiff_lzw"), COLOURS, 1),
    "lab tiff": (saved(PICTURE.convert("LAB"), "TIFF"), COLOURS, 4),
    "ycbcr tiff": (saved(PICTURE, "TIFF", compression="jpeg", quality=100), COLOURS, 4),
    "white is 0": (saved(Image.fromarray(GREY), "TIFF", tiffinfo={262: 0}), GREY, 0),
    "big tiff": (saved(PICTURE, "TIFF", big_tiff=True), COLOURS, 0),
    "several pages": (saved(PICTURE, "TIFF", save_all=True, append_images=[TURNED.copy()]), COLOURS, 0),
    "grey 16 tiff": (saved(Image.fromarray(GREY.astype(np.uint16) * 257), "TIFF"), GREY, 0),
    "rgb 16 tiff": (encoded(".tiff", COLOURS[..., ::-1].astype(np.uint16) * 257), COLOURS, 0),
    "bmp": (saved(PICTURE, "BMP"), COLOURS, 0),
    "webp": (saved(PICTURE, "WEBP", lossless=True), COLOURS, 0),
    "animated webp": (
        saved(PICTURE, "WEBP", save_all=True, append_images=[TURNED.copy()], lossless=True),
        COLOURS,
        0,
    ),
    "animated png": (saved(PICTURE, "PNG", save_all=True, append_images=[TURNED.copy()]), COLOURS, 0),
    "avif": (saved(PICTURE, "AVIF", **FINE), COLOURS, 3),
    "palette": (saved(PICTURE.quantize(8), "PNG"), COLOURS, 1),
    "grey": (saved(PICTURE.convert("L"), "PNG"), GREY, 0),
    "bilevel": (saved(Image.fromarray(GREY > 100), "PNG"), np.uint8(255) * (GREY > 100), 0),
    "grey 16": (saved(Image.fromarray(GREY.astype(np.uint16) * 257), "PNG"), GREY, 0),
    "rgb 16": (encoded(".png", COLOURS[..., ::-1].astype(np.uint16) * 257), COLOURS, 0),
    "one pixel": (saved(Image.new("RGB", (1, 1), (9, 8, 7)), "PNG"), np.array([[[9, 8, 7]]]), 0),
    "thin": (saved(Image.new("RGB", (3000, 1), (9, 8, 7)), "PNG"), np.full((1, 3000, 3), (9, 8, 7)), 0),
}


def two_compressions(data: bytes) -> bytes:
    """A TIFF file whose tag of the compression, 259, says that it has two values, of which Pillow warns."""
    changed = bytearray(data)
    (directory,) = struct.unpack_from("<I", data, 4)
    for entry in range(struct.unpack_from("<H", data, directory)[0]):
        at = directory + 2 + 12 * entry
        if struct.unpack_from("<H", data, at)[0] == 259:
            struct.pack_into("<I", changed, at + 4, 2)
    assert changed != data
    return bytes(changed)


def test_odd_tags_of_a_tiff_are_no_warnings(tmp_path: Path) -> None:
    path = tmp_path / "odd.tif"
    path.write_bytes(two_compressions(saved(PICTURE, "TIFF")))
    assert np.array_equal(load_image(path), COLOURS)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_gives_its_pixels(tmp_path: Path, kind: str) -> None:
    data, wanted, tolerance = KINDS[kind]
    path = tmp_path / "wrong_extension.txt"
    path.write_bytes(data)
    wanted = wanted if wanted.ndim == 3 else wanted[:, :, None].repeat(3, 2)
    loaded = load_image(path)
    assert loaded.dtype == np.uint8 and loaded.flags.writeable and loaded.shape == wanted.shape
    assert np.abs(loaded.astype(int) - wanted).max() <= tolerance
    assert read_header(path)[:3] == (wanted.shape[1], wanted.shape[0], False)


def test_16_bits_are_rounded_and_not_cut(tmp_path: Path) -> None:
    values = np.array([[0, 100, 129, 255, 32767, 33023, 65406, 65535]], np.uint16)
    wanted = np.rint(values / 257).astype(int)
    for name, pixels in (
        ("grey", values),
        ("rgb", values[..., None].repeat(3, 2)),
        ("rgba", values[..., None].repeat(4, 2)),
    ):
        if name == "rgba":
            pixels[..., 3] = 65535
        for suffix in (".png", ".tiff"):
            (tmp_path / name).write_bytes(encoded(suffix, pixels))
            assert np.array_equal(load_image(tmp_path / name), wanted[..., None].repeat(3, 2)), (name, suffix)


def test_grey_palettes_and_straight_transparency_become_rgb(tmp_path: Path) -> None:
    kinds = {
        "grey": (png((3, 1), 8, 0, [bytes([0, 100, 255])]), [[0] * 3, [100] * 3, [255] * 3]),
        "bilevel": (png((3, 1), 1, 0, [b"\xa0"]), [[255] * 3, [0] * 3, [255] * 3]),
        "grey_alpha": (png((3, 1), 8, 4, [bytes([10, 255, 10, 0, 0, 255])]), [[10] * 3, [255] * 3, [0] * 3]),
        "palette": (
            png(
                (3, 1),
                8,
                3,
                [bytes([0, 1, 0])],
                chunk(b"PLTE", bytes([1, 2, 3, 4, 5, 6])) + chunk(b"tRNS", b"\xff\x00"),
            ),
            [[1, 2, 3], [255] * 3, [1, 2, 3]],
        ),
        "alpha": (
            png((3, 1), 8, 6, [bytes([10, 20, 30, 255, 10, 20, 30, 0, 10, 20, 30, 51])]),
            [[10, 20, 30], [255] * 3, [206, 208, 210]],
        ),
    }
    shown: dict[
        int, tuple[bytes, int, list[int]]
    ] = {  # of each depth the row, the transparent value and what is to be seen
        1: (b"\xa0", 0, [255, 255, 255]),
        2: (b"\x1b", 2, [0, 85, 255, 255]),
        4: (b"\x05\xaf", 10, [0, 85, 255, 255]),
        16: (struct.pack(">4H", 0, 1000, 1001, 9), 1000, [0, 255, 4, 0]),
    }
    for bits, (row, value, levels) in shown.items():
        data = png((len(levels), 1), bits, 0, [row], chunk(b"tRNS", struct.pack(">H", value)))
        kinds[f"tRNS {bits}"] = (data, [[level] * 3 for level in levels])
    key = chunk(b"tRNS", struct.pack(">3H", 1, 2, 3))
    kinds["tRNS rgb"] = (png((2, 1), 8, 2, [bytes([1, 2, 3, 1, 2, 4])], key), [[255] * 3, [1, 2, 4]])
    key = chunk(b"tRNS", struct.pack(">3H", 1000, 2000, 3000))
    row = struct.pack(">6H", 1000, 2000, 3000, 1000, 2000, 3001)
    kinds["tRNS rgb 16"] = (png((2, 1), 16, 2, [row], key), [[255] * 3, [4, 8, 12]])
    for name, (data, expected) in kinds.items():
        (tmp_path / name).write_bytes(data)
        assert load_image(tmp_path / name).tolist() == [expected], name
    assert read_header(tmp_path / "palette").alpha and not read_header(tmp_path / "grey").alpha
    red = load_image(tmp_path / "alpha", background=(1.0, 0.0, 0.0))
    assert red.tolist() == [[[10, 20, 30], [255, 0, 0], [206, 4, 6]]]


@pytest.mark.parametrize("orientation", range(10))
def test_captures_are_taken_as_stored_and_photographs_are_turned_upright(
    tmp_path: Path, orientation: int
) -> None:
    clear = np.dstack([COLOURS, GREY])
    for name, pixels, form, options in (
        ("png", COLOURS, "PNG", {}),
        ("rgba", clear, "PNG", {}),
        ("webp", COLOURS, "WEBP", {"lossless": True}),
        ("tiff", COLOURS, "TIFF", {}),
        ("lzw", COLOURS, "TIFF", {"compression": "tiff_lzw"}),
        ("tiff rgba", clear, "TIFF", {}),
        ("jpeg", COLOURS, "JPEG", SOUND),
    ):
        if name == "lzw" and orientation not in range(1, 9):
            continue  # libtiff writes no other
        path = tmp_path / name
        plain = tmp_path / "plain"
        path.write_bytes(oriented(Image.fromarray(pixels), form, orientation, **options))
        plain.write_bytes(saved(Image.fromarray(pixels), form, **options))
        stored = load_image(plain)
        assert np.array_equal(load_image(path), stored), name
        assert read_header(path)[:2] == (96, 64), name
        assert np.array_equal(load_image(path, upright=True), upright(stored, orientation)), name
    stored = turned_jpeg(tmp_path / "b.jpg", NOISE, 1)
    if 0 < orientation < 9:
        assert np.array_equal(
            turned_jpeg(tmp_path / "a.jpg", NOISE, orientation), load_image(tmp_path / "a.jpg", upright=True)
        )
        assert np.array_equal(load_image(tmp_path / "a.jpg"), stored)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_avif_is_turned_by_its_format_for_captures_too(tmp_path: Path, orientation: int) -> None:
    path = tmp_path / "a.avif"
    path.write_bytes(oriented(PICTURE, "AVIF", orientation, **FINE))
    wanted = upright(COLOURS, orientation)
    for loaded in (load_image(path), load_image(path, upright=True)):
        assert loaded.shape == wanted.shape and np.abs(loaded.astype(int) - wanted).max() <= 3
    assert read_header(path)[:2] == wanted.shape[1::-1]


@pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (extra sfm)")
def test_colmap_sees_the_pixels_that_captures_give(tmp_path: Path) -> None:
    """In a process of its own: its libraries clash with Pillow's. It reads no WebP, AVIF or HEIC."""
    kinds = {
        "cmyk jpeg",
        "cmyk tiff",
        "grey 16",
        "rgb 16",
        "rgb 16 tiff",
        "palette",
        "two pictures (MPO)",
        "white is 0",
        "grey",
    }
    files = {kind: KINDS[kind][0] for kind in kinds}
    for orientation in (0, 3, 6, 7):
        for form in ("JPEG", "PNG", "TIFF"):
            files[f"{form} {orientation}"] = oriented(PICTURE, form, orientation)
    names = [
        f"{number}.{kind.split()[-1]}" for number, kind in enumerate(files)
    ]  # the name says nothing of the format
    for name, data in zip(names, files.values(), strict=True):
        (tmp_path / name).write_bytes(data)
    read = (
        "import sys, numpy, pycolmap\n"
        "for name in sys.argv[1:]: numpy.save(name + '.npy', pycolmap.Bitmap.read(name, as_rgb=True).to_array())"
    )
    subprocess.run([sys.executable, "-c", read, *names], cwd=tmp_path, check=True, capture_output=True)
    for kind, name in zip(files, names, strict=True):
        theirs = np.load(tmp_path / f"{name}.npy").astype(int)
        ours = load_image(tmp_path / name)
        assert theirs.shape == ours.shape and np.abs(theirs - ours).max() <= 1, kind


def profile(primaries: list[tuple[float, float]], gamma: float) -> bytes:
    """An ICC profile (version 4) of a display with the primaries (x, y), white D65 and a curve of that
    exponent.
    """

    def fixed(*values: float) -> bytes:
        return b"".join(struct.pack(">i", round(value * 65536)) for value in values)

    white = np.array([0.3127 / 0.329, 1, 0.3583 / 0.329])
    d50 = np.array([0.9642, 1, 0.8249])
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in primaries]).T
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    adapted = np.linalg.inv(bradford) @ np.diag(bradford @ d50 / (bradford @ white)) @ bradford
    matrix = adapted @ columns @ np.diag(np.linalg.solve(columns, white))
    curve = b"para" + bytes(8) + fixed(gamma)
    tags = {b"wtpt": b"XYZ " + bytes(4) + fixed(*d50)}
    for k, name in enumerate((b"r", b"g", b"b")):
        tags[name + b"XYZ"], tags[name + b"TRC"] = b"XYZ " + bytes(4) + fixed(*matrix[:, k]), curve
    table = b""
    body = b""
    at = 132 + 12 * len(tags)
    for name, data in tags.items():
        table += name + struct.pack(">II", at + len(body), len(data))
        body += data
    kind = bytes(4) + struct.pack(">I", 0x04300000) + b"mntrRGB XYZ " + bytes(12) + b"acsp" + bytes(28)
    whole = struct.pack(">I", at + len(body)) + kind + fixed(*d50) + bytes(48)
    return whole + struct.pack(">I", len(tags)) + table + body


P3 = profile([(0.68, 0.32), (0.265, 0.69), (0.15, 0.06)], 2.2)
ADOBE = profile([(0.64, 0.33), (0.21, 0.71), (0.15, 0.06)], 2.19921875)


@pytest.mark.parametrize("given", [P3, ADOBE], ids=["Display P3", "Adobe RGB"])
@pytest.mark.parametrize(
    ("form", "tolerance"), [("PNG", 2), ("TIFF", 2), ("WEBP", 2), ("JPEG", 10), ("AVIF", 10)]
)
def test_colours_of_a_profile_become_srgb(tmp_path: Path, given: bytes, form: str, tolerance: int) -> None:
    there = ImageCms.ImageCmsProfile(io.BytesIO(given))
    srgb = ImageCms.createProfile("sRGB")
    wide = ImageCms.profileToProfile(PICTURE, srgb, there, outputMode="RGB")
    assert wide is not None and np.abs(np.asarray(wide, dtype=int) - COLOURS).max() > 12
    options = {"WEBP": {"lossless": True}, "JPEG": SOUND, "AVIF": FINE}.get(form, {})
    (tmp_path / "a").write_bytes(saved(wide, form, icc_profile=given, **options))
    assert np.abs(load_image(tmp_path / "a").astype(int) - COLOURS).max() <= tolerance
    clear = wide.convert("RGBA")
    clear.putalpha(128)
    if form in ("PNG", "TIFF"):
        (tmp_path / "b").write_bytes(saved(clear, form, icc_profile=given))
        assert np.abs(load_image(tmp_path / "b").astype(int) - (COLOURS / 2 + 127.5)).max() <= tolerance


def test_profiles_that_say_nothing_change_nothing(tmp_path: Path) -> None:
    grey = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name, image, said in (
        ("srgb", PICTURE, grey),
        ("broken", PICTURE, P3[:300]),
        ("nonsense", PICTURE, b"no profile"),
        ("of other pixels", PICTURE.convert("CMYK"), P3),
    ):
        for kept, data in ((said, "with"), (None, "without")):
            (tmp_path / data).write_bytes(saved(image, "TIFF", icc_profile=kept))
        assert np.array_equal(load_image(tmp_path / "with"), load_image(tmp_path / "without")), name


def test_heic_comes_upright_and_needs_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.heic").write_bytes(HEIC)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        with pytest.raises(DataError, match=r"is HEIC.*pip install pillow-heif, or convert"):
            load_image(tmp_path / "a.heic")
    pytest.importorskip("pillow_heif")
    assert read_header(tmp_path / "a.heic") == (48, 64, False, "HEIC")
    assert "HEIF" not in Image.OPEN, "it is not registered for the whole process"
    for turned in (False, True):
        loaded = load_image(tmp_path / "a.heic", upright=turned).astype(int)
        assert loaded.shape == (64, 48, 3)
        for (y, x), colour in {
            (15, 24): (200, 40, 30),
            (50, 12): (20, 60, 220),
            (50, 36): (30, 180, 60),
        }.items():
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
    assert [path.name for path in found] == ["b.png", "a.jpg", "broken.jpg"], (
        "what is named by itself is taken as it is"
    )
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
        (saved(PICTURE, "GIF"), "no PNG, JPEG"),
        (png((20_000, 20_000), 8, 2, []), "20000x20000 pixels; at most 1e+08"),
        (
            png((9_700, 10_000), 8, 2, []),
            "cannot be decoded",
        ),  # fewer than MAX_PIXELS, and Pillow would warn of them
        (
            saved(PICTURE, "TIFF").replace(struct.pack("<I", 96), struct.pack("<I", 1_500_000)),
            "1500000x64 pixels",
        ),
        (png((0, 5), 8, 2, []), "cannot be decoded"),
        (encoded(".png", NOISE)[:100] + b"?" + encoded(".png", NOISE)[101:], "checksum"),
        (saved(Image.fromarray(np.zeros((4, 4), np.float32)), "TIFF"), "32 bits"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, content: bytes, finding: str) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(DataError, match=re.escape(finding)) as caught:
        load_image(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "kind", ["jpeg", "cmyk jpeg", "webp", "big tiff", "cmyk tiff, packed", "bmp", "avif", "rgb 16", "heic"]
)
def test_a_file_is_refused_wherever_it_is_cut(tmp_path: Path, kind: str) -> None:
    data = KINDS[kind][0] if kind != "heic" else HEIC
    if kind == "jpeg":  # a thumbnail with an end of its own, as cameras write
        small = saved(Image.fromarray(NOISE), "JPEG")
        data = data[:2] + b"\xff\xe1" + struct.pack(">H", len(small) + 2) + small + data[2:]
    path = tmp_path / "a"
    for length in {*range(0, len(data) - 4, 1 + len(data) // 97), len(data) - 8 - 2 * (kind == "rgb 16")}:
        path.write_bytes(data[:length])
        with pytest.raises(DataError):
            load_image(path)


MASKS = [
    "L",
    "1",
    "01",
    "16",
    "01 of 16",
    "RGB",
    "01 RGB",
    "red on black",
    "red on white",
    "opaque RGBA",
    "RGBA",
    "black RGBA",
]
MASKS += ["other RGBA", "LA", "opaque LA", "palette", "swapped palette", "dark palette"]
LEFT = np.zeros((64, 96), np.uint8)
LEFT[:, :48] = 255
PALETTE = Image.fromarray((LEFT > 0).astype(np.uint8), "P")
PALETTE.putpalette([0, 0, 0, 255, 0, 0])
SWAPPED = Image.fromarray((LEFT == 0).astype(np.uint8), "P")
SWAPPED.putpalette([255, 255, 255, 0, 0, 0])
LABELS = Image.fromarray((LEFT > 0).astype(np.uint8), "P")
LABELS.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0])


@pytest.mark.parametrize(
    "mask",
    [
        Image.fromarray(LEFT),
        Image.fromarray(LEFT > 0),
        Image.fromarray((LEFT > 0).astype(np.uint8)),
        Image.fromarray(LEFT.astype(np.uint16) * 257),
        Image.fromarray((LEFT > 0).astype(np.uint16)),
        Image.fromarray(np.dstack([LEFT] * 3)),
        Image.fromarray(np.dstack([LEFT // 255] * 3)),
        Image.fromarray(np.dstack([LEFT, LEFT * 0, LEFT * 0])),  # red on black
        Image.fromarray(np.dstack([LEFT * 0 + 255, LEFT, LEFT])),  # red where white is not
        Image.fromarray(np.dstack([LEFT] * 3 + [LEFT * 0 + 255])),
        Image.fromarray(np.dstack([LEFT * 0 + 255] * 3 + [LEFT])),
        Image.fromarray(np.dstack([LEFT * 0] * 3 + [LEFT])),
        Image.fromarray(np.dstack([255 - LEFT] * 3 + [LEFT])),
        Image.fromarray(np.dstack([LEFT * 0, LEFT])),
        Image.fromarray(np.dstack([LEFT, LEFT * 0 + 255])),
        PALETTE,
        SWAPPED,
        LABELS,
    ],
    ids=MASKS,
)
def test_white_or_opaque_is_used_in_every_kind_of_mask(tmp_path: Path, mask: Image.Image) -> None:
    mask.save(tmp_path / "m.png")
    assert np.array_equal(load_mask(tmp_path / "m.png", (96, 64)), LEFT > 0)
    assert np.array_equal(load_mask(tmp_path / "m.png", (48, 32)), LEFT[::2, ::2] > 0)


def test_masks_of_one_value_and_with_noise(tmp_path: Path) -> None:
    path = tmp_path / "m"
    for value, used in ((0, False), (1, True), (255, True)):
        path.write_bytes(saved(Image.fromarray(np.full_like(LEFT, value)), "PNG"))
        assert (load_mask(path) == used).all(), value
    clear = Image.fromarray(np.dstack([LEFT * 0 + 255, LEFT * 0]))
    path.write_bytes(saved(clear, "PNG"))
    assert not load_mask(path).any(), "transparent is not used"
    draw = np.random.default_rng(0)
    for low in (0, 250):
        path.write_bytes(
            saved(Image.fromarray(draw.integers(low, low + 5, (64, 96), dtype=np.uint8)), "JPEG", quality=95)
        )
        assert (load_mask(path) == (low > 0)).all(), "noise of JPEG is no mask"
    soft = cv2.GaussianBlur(LEFT, (0, 0), 2)
    path.write_bytes(saved(Image.fromarray(soft), "PNG"))
    assert np.array_equal(load_mask(path), soft > 127)


def test_masks_that_leave_nothing_or_everything_are_told(tmp_path: Path) -> None:
    write_transforms(tmp_path, Capture.make(3))
    scene = parse_scene(tmp_path, 1, None)
    assert useless_masks(scene) == ""
    for values, said in (
        ((0, 0, 0), "no pixel"),
        ((255, 1, 255), "every pixel"),
        ((0, 255, 0), ""),
        ((0, 0, None), ""),
    ):
        paths = [None if value is None else tmp_path / f"{k}.png" for k, value in enumerate(values)]
        for path, value in zip(paths, values, strict=True):
            if path is not None:
                cv2.imwrite(str(path), np.full((8, 8), value, np.uint8))
        found = useless_masks(replace(scene, masks=tuple(paths)))
        assert said in found and bool(said) == bool(found)


def test_sizes_need_not_be_whole_parts(tmp_path: Path) -> None:
    write_transforms(tmp_path, Capture.make(3))
    whole, part = (parse_scene(tmp_path, by, None).cameras for by in (1, 1.7))
    assert torch.equal(part.size, (whole.size / 1.7).round().long())
    # Whole pixels are a little wider or taller than asked for, and the lens goes with them.
    torch.testing.assert_close(part.focal / whole.focal, part.size.double() / whole.size)
    torch.testing.assert_close(part.centre / whole.centre, part.size.double() / whole.size)
    images = load_images(parse_scene(tmp_path, 1.7, None), (0.0, 0.0, 0.0), [0, 1, 2])
    assert [image.shape[1::-1] for image in images] == [tuple(size) for size in part.size.tolist()]
