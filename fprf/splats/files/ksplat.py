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
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ..gaussians import COUNTS
from . import base
from .base import Capture, CaptureFormat, Data, Floats

_KSPLAT_HEADER = struct.Struct("<BBxxII4xIHxx12xff")
"""Version, sections at most and in all, Gaussians in all, compression, bounds of harmonics."""
_SECTION_HEADER = struct.Struct("<IIIIfHxxI4xIIH")
"""Gaussians and room for them, buckets and their size, full and other ones, degree."""
_HEADER_BYTES = 4096
"""Bytes of the header of the file."""
_SECTION_BYTES = 1024
"""Bytes of that of a section."""
_HARMONIC_LIMITS = (-1.5, 1.5)
"""Harmonics of 8 bits lie between these where the header says nothing."""
_HALF_BUCKET_STEPS = 32767
"""Steps from the middle of a bucket to its sides where the section says nothing."""
_MIN_DEVIATION = 1e-12
"""Standard deviations are at least this, so that their logarithm is finite."""


@dataclass(frozen=True, kw_only=True)
class Ksplat(CaptureFormat):
    """mkkellogg's .ksplat."""

    writes: ClassVar[bool] = False

    def recognises(self, head: bytes, size: int) -> bool:
        return head[:1] == b"\0" and head[1:2] > b"\0" and size >= _HEADER_BYTES

    def read(self, path: Path, data: Data) -> Capture:
        if not self.recognises(data[:2], len(data)):
            raise DataError(f"{path}: no .ksplat of version 0.1 or later; it is damaged or of another kind")
        # Headers of all sections follow that of the file; then come their bodies, in the same order.
        _, _, most, _, total, compression, low, high = _KSPLAT_HEADER.unpack_from(data)
        if compression > 2:
            raise DataError(f"{path}: a .ksplat of compression {compression}; 0, 1 and 2 can be read")
        start = _HEADER_BYTES + most * _SECTION_BYTES
        if start > len(data):
            raise base.short(path, len(data), start, f"{most} headers of sections")
        limits = (low or _HARMONIC_LIMITS[0], high or _HARMONIC_LIMITS[1])
        sections = []
        degrees = set[int]()
        total_read = 0
        for number in range(most):
            numbers = _SECTION_HEADER.unpack_from(data, _HEADER_BYTES + number * _SECTION_BYTES)
            section = _Section(*numbers)
            table = section.table(path, data, number, compression, start)
            if section.number:
                places = None
                if compression:
                    places = section.places(path, data, number, start)
                sections.append((section.number, partial(_decoded, table, places, limits=limits)))
                degrees.add(section.degree)
            total_read += section.number
            start = section.body(start) + table.itemsize * section.room
        if total_read != total or len(degrees) != 1:
            raise DataError(
                f"{path}: sections of {total_read} Gaussians and degrees {sorted(degrees)}; the header says {total}"
            )
        gaussians, shift = base.decoded(COUNTS[degrees.pop()], *sections)
        return Capture(path, gaussians, False, data, lambda harmonics, changed: (), shift=shift)


class _Places(NamedTuple):
    """Sections that steps of 16 bits are positions in."""

    corners: Floats
    """Of each Gaussian's bucket [N 3]."""
    step: float


class _Section(NamedTuple):
    """The header of a section."""

    number: int
    """Gaussians."""
    room: int
    """Gaussians that there is room for."""
    bucket_count: int
    """Gaussians of a full bucket."""
    buckets: int
    side: float
    """Of a bucket."""
    centre_bytes: int
    """Of a bucket's centre, as it is stored."""
    half_steps: int
    """From a corner of a bucket to its centre; 0 = 32767."""
    full: int
    others: int
    """Buckets that are not full; each says its number."""
    degree: int

    def body(self, start: int) -> int:
        """Offset of the Gaussians: behind the sizes of buckets that are not full, and all centres."""
        return start + 4 * self.others + self.centre_bytes * self.buckets

    def table(self, path: Path, data: Data, number: int, compression: int, start: int) -> NDArray[Any]:
        """The rows of the section whose body is at `start`. Raises DataError where it is damaged."""
        short_centres = compression and self.buckets and self.centre_bytes < 12
        if self.degree > 2 or short_centres or self.number > self.room:
            raise DataError(
                f"{path}: section {number} of degree {self.degree} with {self.number} of {self.room} Gaussians; "
                "it is damaged"
            )
        first = "<u2" if compression else "<f4"
        half = "<f2" if compression else "<f4"
        rest = "u1" if compression == 2 else half
        record = np.dtype([
            ("mean", first, 3),
            ("deviation", half, 3),
            ("turn", half, 4),
            ("rgba", "u1", 4),
            ("rest", rest, 3 * (COUNTS[self.degree] - 1)),
        ])  # fmt: skip
        end = self.body(start) + record.itemsize * self.number
        if end > len(data):
            raise base.short(path, len(data), end, f"section {number} of {self.number} Gaussians")
        return np.frombuffer(data, record, self.number, self.body(start))

    def places(self, path: Path, data: Data, number: int, start: int) -> _Places:
        """The corner of each Gaussian's bucket: positions are steps from there. Raises DataError where there
        are too few buckets.
        """
        # Full buckets come first; the others say how many Gaussians they have.
        full = np.full(min(self.full, self.buckets), self.bucket_count)
        sizes = np.concatenate([full, np.frombuffer(data, "<u4", self.others, start)])
        bucket = np.searchsorted(np.cumsum(sizes), np.arange(self.number), side="right")
        if bucket[-1] >= self.buckets:
            raise DataError(
                f"{path}: section {number} has {self.number} Gaussians in {self.buckets} buckets; it is damaged"
            )
        half_steps = self.half_steps or _HALF_BUCKET_STEPS
        centres = np.ndarray((self.buckets, 3), "<f4", data, start + 4 * self.others, (self.centre_bytes, 4))
        step = self.side / 2 / half_steps
        return _Places((centres - half_steps * step)[bucket], step)


def _decoded(
    table: NDArray[Any], places: _Places | None, rows: slice, *, limits: tuple[float, float]
) -> tuple[Floats, ...]:
    """Means, quaternions, ln-scales, logits and harmonics of some Gaussians of a section."""
    some = table[rows]
    share = some["rgba"] / 255
    means = some["mean"]
    if places is not None:
        means = means * places.step + places.corners[rows]
    rest = some["rest"].astype(np.float64)
    if some["rest"].dtype == np.uint8:
        rest = limits[0] + rest / 255 * (limits[1] - limits[0])
    # Degree by degree, in each channel by channel.
    bands = []
    for each in (rest[:, :9], rest[:, 9:]):
        if each.shape[1]:
            bands.append(each.reshape(len(some), 3, -1).transpose(0, 2, 1))
    harmonics = np.concatenate([base.constants_of(share[:, :3]), *bands], 1)
    scales = np.log(np.maximum(some["deviation"].astype(np.float64), _MIN_DEVIATION))
    return means, some["turn"], scales, base.logit(share[:, 3]), harmonics
