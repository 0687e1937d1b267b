"""What a photograph says of its camera: model and focal length, from the EXIF block of a JPEG, which HEIC files also have."""

import struct
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

__all__ = ["Lens", "heic_exif", "lens_of", "read_lens"]

_HEAD = 1 << 17
"""EXIF lies within the first 64 KiB of a JPEG."""
_MODEL, _EXIF, _FOCAL, _FOCAL_35 = 0x0110, 0x8769, 0x920A, 0xA405
_SIZES = {2: 1, 3: 2, 4: 4, 5: 8}
"""Bytes of a value by type: text, short, long, fraction."""


class Lens(NamedTuple):
    """Two photographs of equal size and equal lens are taken with one camera."""

    model: str = ""
    focal: float = 0.0
    """Millimetres; 0 where the file does not say."""
    focal_35: int = 0
    """The same as on 35 mm film."""


def read_lens(path: Path) -> Lens:
    """The lens of a photograph; an empty one where its file says nothing, or nothing that can be understood."""
    try:
        with path.open("rb") as file:
            return lens_of(file.read(_HEAD))
    except OSError:
        return Lens()


def heic_exif(path: Path) -> bytes:
    """The EXIF block of a HEIC file that can be decoded, for a JPEG of its pixels: without orientation, which these have had.

    Empty where there is none, it is longer than a JPEG takes, or the file is none.
    """
    if not find_spec("pillow_heif"):
        return b""
    import pillow_heif

    if not pillow_heif.is_supported(path):
        return b""
    info = pillow_heif.open_heif(path).info
    pillow_heif.set_orientation(info)
    block: bytes = info.get("exif") or b""
    return block if len(block) < (1 << 16) - 2 else b""


def lens_of(data: bytes) -> Lens:
    """The lens of a photograph by the first bytes of its file."""
    try:
        return _lens(_tiff(data))
    except (struct.error, IndexError, ValueError):
        return Lens()


def _tiff(data: bytes) -> bytes:
    """The TIFF structure within a JPEG's EXIF segment; empty without one."""
    at = 2
    while data.startswith(b"\xff\xd8") and at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at + 1] == 0xE1 and data[at + 4 : at + 10] == b"Exif\0\0":
            return data[at + 10 : at + 2 + length]
        at += 2 + length
    return b""


def _lens(tiff: bytes) -> Lens:
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return Lens()
    first = _entries(tiff, order, struct.unpack_from(order + "I", tiff, 4)[0])
    inner = _entries(tiff, order, int.from_bytes(first[_EXIF], "little" if order == "<" else "big")) if _EXIF in first else {}
    focal, short = inner.get(_FOCAL, b""), inner.get(_FOCAL_35, b"")
    top, bottom = struct.unpack(order + "II", focal) if len(focal) == 8 else (0, 1)
    model = first.get(_MODEL, b"").split(b"\0")[0].decode("ascii", "replace").strip()
    return Lens(model, top / bottom if bottom else 0.0, struct.unpack(order + "H", short)[0] if len(short) == 2 else 0)


def _entries(tiff: bytes, order: str, at: int) -> dict[int, bytes]:
    """Values of a directory by tag, of the types that are read."""
    found = {}
    (count,) = struct.unpack_from(order + "H", tiff, at)
    for k in range(min(count, 256)):
        tag, kind, number = struct.unpack_from(order + "HHI", tiff, at + 2 + 12 * k)
        size, place = _SIZES.get(kind, 0) * number, at + 10 + 12 * k
        if 0 < size <= 4096:
            start = place if size <= 4 else struct.unpack_from(order + "I", tiff, place)[0]
            found[tag] = tiff[start : start + size]
    return found
