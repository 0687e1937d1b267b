"""Raw photographs made by code: TIFF files whose first picture is a thumbnail and whose sensor data lie inside."""

import struct
from typing import Any

import numpy as np

SRGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_FORMATS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 10: "ii"}
Entries = dict[int, tuple[int, list[Any]]]


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def tiff(
    first: Entries, inside: Entries | None, strips: list[bytes], *, mark: bytes = b"", order: str = "<"
) -> bytes:
    """A TIFF file of a directory and one inside of it; an offset "strip 0" is where the first strip begins."""
    directories = [first] if inside is None else [first, inside]
    at = 8 + len(mark) + sum(2 + 12 * len(each) + 4 for each in directories)
    places = [8 + len(mark)]
    places.append(places[0] + 2 + 12 * len(first) + 4)
    where = {}
    for k, strip in enumerate(strips):
        where[f"strip {k}"] = at
        at += len(strip) + len(strip) % 2
    where["inside"] = places[1]
    beyond = b""
    body = b""
    for directory in directories:
        body += struct.pack(f"{order}H", len(directory))
        for tag, (kind, values) in sorted(directory.items()):
            values = [where.get(value, value) if isinstance(value, str) else value for value in values]
            if kind == 2:
                data = values[0] + b"\0"
                count = len(data)
            else:
                data = b"".join(
                    struct.pack(
                        f"{order}{_FORMATS[kind]}", *(value if isinstance(value, tuple) else (value,))
                    )
                    for value in values
                )
                count = len(values)
            if len(data) > 4:
                field = struct.pack(f"{order}I", at + len(beyond))
                beyond += data + b"\0" * (len(data) % 2)
            else:
                field = data.ljust(4, b"\0")
            body += struct.pack(f"{order}HHI", tag, kind, count) + field
        body += struct.pack(f"{order}I", 0)
    magic = b"II*\0" if order == "<" else b"MM\0*"
    held = b"".join(strip + b"\0" * (len(strip) % 2) for strip in strips)
    return magic + struct.pack(f"{order}I", places[0]) + mark + body + held + beyond


def thumbnail(pixels: np.ndarray, *, reduced: bool = True) -> Entries:
    """The directory of an RGB picture [H W 3] in strip 0."""
    height, width = pixels.shape[:2]
    return {
        254: (4, [int(reduced)]),
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [8, 8, 8]),
        259: (3, [1]),
        262: (3, [2]),
        273: (4, ["strip 0"]),
        277: (3, [3]),
        278: (4, [height]),
        279: (4, [pixels.size]),
    }


def dng(
    srgb: np.ndarray,
    small: np.ndarray,
    *,
    version: bool = True,
    neutral: tuple[float, float, float] = (1.0, 1.0, 1.0),
    orientation: int = 1,
) -> bytes:
    """A DNG of sRGB colours [H W 3] in [0, 1], seen by a camera whose channels are those of sRGB times
    `neutral` (the camera's white).
    """
    height, width = srgb.shape[:2]
    light = linear(srgb) * np.array(neutral)
    mosaic = light[..., 1].copy()
    mosaic[::2, ::2] = light[::2, ::2, 0]
    mosaic[1::2, 1::2] = light[1::2, 1::2, 2]
    sensor = np.rint(mosaic * 16383).astype("<u2")
    fraction = [(round(value * 10000), 10000) for value in neutral]
    matrix = np.diag(neutral) @ np.linalg.inv(SRGB_TO_XYZ)
    first = thumbnail(small) | {
        271: (2, [b"fprf"]),
        272: (2, [b"test camera"]),
        274: (3, [orientation]),
        330: (4, ["inside"]),
        37386: (5, [(35, 1)]),
        41989: (3, [52]),
    }
    if version:
        first |= {
            50706: (1, [1, 4, 0, 0]),
            50707: (1, [1, 1, 0, 0]),
            50708: (2, [b"fprf test camera"]),
            50721: (10, [(round(value * 10000), 10000) for value in matrix.flatten()]),
            50728: (5, fraction),
            50778: (3, [21]),
        }
    inside: Entries = {
        254: (4, [0]),
        256: (4, [width]),
        257: (4, [height]),
        258: (3, [16]),
        259: (3, [1]),
        262: (3, [32803]),
        273: (4, ["strip 1"]),
        277: (3, [1]),
        278: (4, [height]),
        279: (4, [sensor.nbytes]),
        33421: (3, [2, 2]),
        33422: (1, [0, 1, 1, 2]),
        50714: (4, [0]),
        50717: (4, [16383]),
    }
    return tiff(first, inside, [small.tobytes(), sensor.tobytes()])
