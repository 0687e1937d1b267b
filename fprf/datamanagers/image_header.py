"""Size and transparency of an image file, from its first bytes: nothing is decoded, so a bomb costs nothing.

PNG, JPEG, WebP, BMP, TIFF, HEIC and AVIF, told by their content and not by the file's name.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from ..errors import DataError

__all__ = ["IMAGE_SUFFIXES", "ImageHeader", "header_of", "read_header"]

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif"})
"""What is taken for an image when a folder is listed, in lower case."""

_HEAD = 1 << 18
"""Bytes read at first: more than any camera's EXIF block with its thumbnail."""
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_TIFF_TYPES = {1: "B", 3: "H", 4: "I"}
_AVIF = frozenset({b"avif", b"avis"})
_HEIF = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
"""Brands of the ISO base media format that mark still images."""
_ALPHA = (b"auxiliary:alpha", b"hevc:2015:auxid:1")
"""Types of an auxiliary image that is the alpha channel."""


class ImageHeader(NamedTuple):
    """What a file says of its image, as stored: EXIF orientation is not applied.

    HEIC and AVIF store rotation in the image itself (`irot`), which decoders apply: width and height are those after it.
    """

    width: int
    height: int
    alpha: bool
    kind: str
    """png, jpeg, webp, bmp, tiff, heic or avif."""


def read_header(path: Path) -> ImageHeader:
    """The header of an image file. Raises DataError where the file is absent, empty, or of no known format."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            header = header_of(head)
            if header is None and len(head) == _HEAD:
                header = header_of(head + file.read())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error
    if not head:
        raise DataError(f"{path}: the file is empty; restore the image or remove it from the scene")
    if header is None:
        raise DataError(
            f"{path}: no PNG, JPEG, WebP, BMP, TIFF, HEIC or AVIF header; replace the file or convert the image to PNG"
        )
    if header.width < 1 or header.height < 1:
        raise DataError(f"{path}: the header says {header.width}x{header.height} pixels; replace the file")
    return header


def header_of(data: bytes) -> ImageHeader | None:
    """The header in the first bytes of a file; None where they hold no known or no whole one."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png(data)
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
        if data.startswith(b"BM"):
            return _bmp(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data)
        if data[4:8] == b"ftyp":
            return _heif(data)
    except (struct.error, IndexError, KeyError):
        return None
    return None


def _png(data: bytes) -> ImageHeader | None:
    if data[12:16] != b"IHDR":
        return None
    width, height, _, colour = struct.unpack_from(">IIBB", data, 16)
    alpha = colour in (4, 6)
    at = 33
    while not alpha and at + 8 <= len(data) and data[at + 4 : at + 8] != b"IDAT":
        alpha = data[at + 4 : at + 8] == b"tRNS"
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    return ImageHeader(width, height, alpha, "png")


def _jpeg(data: bytes) -> ImageHeader | None:
    at = 2
    while True:
        while data[at] == 0xFF and data[at + 1] == 0xFF:
            at += 1
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return ImageHeader(width, height, False, "jpeg")
        if marker in (0xD9, 0xDA):
            return None
        at += 2 if marker == 0x01 or 0xD0 <= marker <= 0xD8 else 2 + struct.unpack_from(">H", data, at + 2)[0]


def _webp(data: bytes) -> ImageHeader | None:
    if data[12:16] == b"VP8X":
        width = 1 + int.from_bytes(data[24:27], "little")
        height = 1 + int.from_bytes(data[27:30], "little")
        return ImageHeader(width, height, bool(data[20] & 0x10), "webp") if len(data) >= 30 else None
    if data[12:16] == b"VP8L" and data[20] == 0x2F:
        bits = struct.unpack_from("<I", data, 21)[0]
        return ImageHeader(1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), bool(bits >> 28 & 1), "webp")
    if data[12:16] == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        return ImageHeader(width & 0x3FFF, height & 0x3FFF, False, "webp")
    return None


def _bmp(data: bytes) -> ImageHeader | None:
    width, height, _, bits = struct.unpack_from("<iiHH", data, 18)
    return ImageHeader(width, abs(height), bits == 32, "bmp")


def _tiff(data: bytes) -> ImageHeader | None:
    order = "<" if data[:2] == b"II" else ">"
    start = struct.unpack_from(order + "I", data, 4)[0]
    tags: dict[int, int] = {}
    for k in range(struct.unpack_from(order + "H", data, start)[0]):
        at = start + 2 + 12 * k
        tag, type_, count = struct.unpack_from(order + "HHI", data, at)
        if count == 1 and type_ in _TIFF_TYPES:
            tags[tag] = struct.unpack_from(order + _TIFF_TYPES[type_], data, at + 8)[0]
    if 256 not in tags or 257 not in tags:
        return None
    return ImageHeader(tags[256], tags[257], tags.get(277, 1) in (2, 4), "tiff")


def _heif(data: bytes) -> ImageHeader | None:
    """The primary image of a HEIC or AVIF file (ISO/IEC 23008-12), cropped and rotated by its own properties."""
    brands = {data[at : at + 4] for at in range(8, min(struct.unpack_from(">I", data)[0], 256), 4)}
    if not brands & (_AVIF | _HEIF):
        return None
    whole = {kind: (start, end) for kind, start, end in _boxes(data, 0, len(data))}
    meta = {kind: (start, end) for kind, start, end in _boxes(data, whole[b"meta"][0] + 4, whole[b"meta"][1])}
    parts = {kind: (start, end) for kind, start, end in _boxes(data, *meta[b"iprp"])}
    properties = list(_boxes(data, *parts[b"ipco"]))
    at = meta[b"pitm"][0]
    (primary,) = struct.unpack_from(">H" if data[at] == 0 else ">I", data, at + 4)
    width, height, turned = 0, 0, False
    for index in _properties_of(data, parts[b"ipma"][0], primary):
        kind, start, _ = properties[index - 1]
        if kind == b"ispe":
            width, height = struct.unpack_from(">II", data, start + 4)
        elif kind == b"clap":
            across, by, down, by_too = struct.unpack_from(">4I", data, start)
            width, height = across // max(by, 1), down // max(by_too, 1)
        elif kind == b"irot":
            turned = bool(data[start] & 1)
    alpha = any(kind == b"auxC" and any(name in data[start:end] for name in _ALPHA) for kind, start, end in properties)
    if turned:
        width, height = height, width
    return ImageHeader(width, height, alpha, "avif" if brands & _AVIF else "heic")


def _properties_of(data: bytes, at: int, item: int) -> list[int]:
    """Numbers, from 1, of the properties of an item, by the content of an `ipma` box at `at`."""
    version, long = data[at], data[at + 3] & 1
    (count,) = struct.unpack_from(">I", data, at + 4)
    at += 8
    for _ in range(count):
        (number,) = struct.unpack_from(">I" if version else ">H", data, at)
        at += 4 if version else 2
        size, at = data[at], at + 1
        end = at + size * (1 + long)
        if number == item:
            return [n & (0x7FFF if long else 0x7F) for n in struct.unpack_from(f">{size}{'H' if long else 'B'}", data, at)]
        at = end
    return []


def _boxes(data: bytes, at: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of the content of each box in a part of an ISO base media file."""
    while at + 8 <= end:
        length, kind = struct.unpack_from(">I4s", data, at)
        if length < 8:  # 0: up to the end of the file, 1: longer than 4 GiB; neither holds what describes an image
            return
        yield kind, at + 8, at + length
        at += length
