"""The .ksplat file (mkkellogg's GaussianSplats3D), read alone: a header of 4096 bytes, headers of sections of
1024, sections.

Of each Gaussian: position, standard deviations, quaternion w x y z, RGBA bytes and harmonics up to degree 2,
degree by degree, in each channel by channel. Compression 0: float32; 1 and 2: positions of 16 bits about the
centre of a bucket, float16 for the rest, and harmonics of float16 or of 8 bits. A section begins with the
sizes of its buckets that are not full, and all centres.
"""

import struct
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ..gaussians import COUNTS
from . import base
from .base import Capture, CaptureFormat, Data, Floats

_HEADER = struct.Struct("<BBxxII4xIHxx12xff")
_SECTION = struct.Struct("<IIIIfHxxI4xIIH")
_HEADER_SIZE = 4096
_SECTION_SIZE = 1024
_LIMITS = (-1.5, 1.5)
"""Harmonics of 8 bits lie between these where the header says nothing."""
_REACH = 32767
"""Steps from the middle of a bucket to its sides where the section says nothing."""
_LEAST = 1e-12


@dataclass(frozen=True, kw_only=True)
class Ksplat(CaptureFormat):
    """mkkellogg's .ksplat."""

    writes: ClassVar[bool] = False

    def recognises(self, head: bytes, size: int) -> bool:
        return head[:1] == b"\0" and head[1:2] > b"\0" and size >= _HEADER_SIZE

    def read(self, path: Path, data: Data) -> Capture:
        if not self.recognises(data[:2], len(data)):
            raise DataError(f"{path}: no .ksplat of version 0.1 or later; it is damaged or of another kind")
        # Headers of all sections follow that of the file; then come their bodies, in the same order.
        _, _, most, _, total, compression, low, high = _HEADER.unpack_from(data)
        if compression > 2:
            raise DataError(f"{path}: a .ksplat of compression {compression}; 0, 1 and 2 can be read")
        start = _HEADER_SIZE + most * _SECTION_SIZE
        sections = []
        degrees = set[int]()
        total_read = 0
        if start > len(data):
            raise base.short(path, len(data), start, f"{most} headers of sections")
        decode = partial(_decoded, limits=(low or _LIMITS[0], high or _LIMITS[1]))
        for k in range(most):
            section = _SECTION.unpack_from(data, _HEADER_SIZE + k * _SECTION_SIZE)
            count, room, of_bucket, buckets, side, stored, reach, full, others, degree = section
            if degree > 2 or (compression and buckets and stored < 12) or count > room:
                raise DataError(
                    f"{path}: section {k} of degree {degree} with {count} of {room} Gaussians; it is damaged"
                )
            # A body: sizes of buckets that are not full, centres of all buckets, Gaussians.
            body = start + 4 * others + stored * buckets
            if compression == 0:
                first, half = ("<f4", "<f4")
            else:
                first, half = ("<u2", "<f2")
            shape = [("mean", first, 3), ("deviation", half, 3), ("turn", half, 4), ("rgba", "u1", 4)]
            record = np.dtype(
                [*shape, ("rest", "u1" if compression == 2 else half, 3 * (COUNTS[degree] - 1))]
            )
            if body + record.itemsize * count > len(data):
                raise base.short(
                    path, len(data), body + record.itemsize * count, f"section {k} of {count} Gaussians"
                )
            table = np.frombuffer(data, record, count, body)
            centres = None
            factor = 0.0
            if compression and count:
                # Full buckets come first; the others say how many Gaussians they have.
                sizes = np.concatenate(
                    [np.full(min(full, buckets), of_bucket), np.frombuffer(data, "<u4", others, start)]
                )
                bucket = np.searchsorted(np.cumsum(sizes), np.arange(count), side="right")
                if bucket[-1] >= buckets:
                    raise DataError(
                        f"{path}: section {k} has {count} Gaussians in {buckets} buckets; it is damaged"
                    )
                # Positions are steps from a corner of their bucket, `reach` to its centre.
                reach = reach or _REACH
                places = np.ndarray((buckets, 3), "<f4", data, start + 4 * others, (stored, 4))
                factor = side / 2 / reach
                centres = (places - reach * factor)[bucket]
            if count:
                sections.append((count, partial(decode, table, centres, factor)))
                degrees.add(degree)
            total_read += count
            start = body + record.itemsize * room
        if total_read != total or len(degrees) != 1:
            raise DataError(
                f"{path}: sections of {total_read} Gaussians and degrees {sorted(degrees)}; the header says {total}"
            )
        gaussians, shift = base.decoded(COUNTS[degrees.pop()], *sections)
        return Capture(path, gaussians, False, data, lambda harmonics, changed: (), shift=shift)


def _decoded(
    table: NDArray[Any], centres: Floats | None, factor: float, rows: slice, *, limits: tuple[float, float]
) -> tuple[Floats, ...]:
    """Means, quaternions, ln-scales, logits and harmonics of some Gaussians of a section."""
    some = table[rows]
    share = some["rgba"] / 255
    if centres is None:
        means = some["mean"]
    else:
        means = some["mean"] * factor + centres[rows]
    rest = some["rest"].astype(np.float64)
    if some["rest"].dtype == np.uint8:
        rest = limits[0] + rest / 255 * (limits[1] - limits[0])
    # Degree by degree, in each channel by channel.
    bands = []
    for each in (rest[:, :9], rest[:, 9:]):
        if each.shape[1]:
            bands.append(each.reshape(len(some), 3, -1).transpose(0, 2, 1))
    harmonics = np.concatenate([base.constants_of(share[:, :3]), *bands], 1)
    scales = np.log(np.maximum(some["deviation"].astype(np.float64), _LEAST))
    return means, some["turn"], scales, base.logit(share[:, 3]), harmonics
