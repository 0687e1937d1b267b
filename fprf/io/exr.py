"""OpenEXR files of 32-bit floats, written by hand: single-part scan lines, ZIP-compressed line by line.

Channels keep their names: R G B in linear light, Z the depth, A the coverage, N.X N.Y N.Z a normal.
"""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from ..errors import DataError
from .atomic import write_bytes

__all__ = ["linear", "write_exr"]

Plane = Annotated[NDArray[np.float32], "H W"]

_FLOAT, _ZIPS = 2, 2


def linear(colour: Annotated[NDArray[np.float32], "H W 3"]) -> Annotated[NDArray[np.float32], "H W 3"]:
    """sRGB in [0, 1] as linear light, which is what EXR readers expect of R, G and B (IEC 61966-2-1)."""
    bent = ((colour + 0.055) / 1.055) ** 2.4
    return np.where(colour <= 0.04045, colour / 12.92, bent).astype(np.float32)


def write_exr(path: Path, channels: Mapping[str, Plane]) -> None:
    """Write planes of one size, whole or not at all. Raises DataError for none, or for several sizes."""
    sizes = {plane.shape for plane in channels.values()}
    if len(sizes) != 1:
        raise DataError(f"{path}: an EXR needs channels of one size; found {sorted(sizes)}")
    ((height, width),) = sizes
    names = sorted(channels)  # the order that the format asks for
    header = struct.pack("<II", 20000630, 2)
    listed = b"".join(name.encode("ascii") + b"\0" + struct.pack("<IB3xII", _FLOAT, 0, 1, 1) for name in names) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    for name, kind, value in (
        ("channels", "chlist", listed),
        ("compression", "compression", bytes([_ZIPS])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<ff", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ):
        header += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<I", len(value)) + value
    header += b"\0"
    stacked = np.stack([np.ascontiguousarray(channels[name], dtype="<f4") for name in names], 1)
    blocks = [_block(y, stacked[y].tobytes()) for y in range(height)]
    offsets, at = [], len(header) + 8 * height
    for block in blocks:
        offsets.append(at)
        at += len(block)
    write_bytes(path, header + struct.pack(f"<{height}Q", *offsets) + b"".join(blocks))


def _block(y: int, raw: bytes) -> bytes:
    """A scan line: even bytes before odd ones, differences, deflated; as it is where that would be longer."""
    data = np.frombuffer(raw, np.uint8)
    sorted_ = np.concatenate([data[0::2], data[1::2]]).astype(np.int16)
    steps = np.concatenate([sorted_[:1], sorted_[1:] - sorted_[:-1] + 128]) & 255
    packed = zlib.compress(steps.astype(np.uint8).tobytes(), 4)
    body = packed if len(packed) < len(raw) else raw
    return struct.pack("<iI", y, len(body)) + body
