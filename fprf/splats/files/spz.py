"""The .spz file (Niantic): gzip of a 16-byte header and one stream a property (versions 1 to 3), or zstd
streams (version 4).

Streams: positions of 24 bits with a common number of fractional bits (version 1: float16), opacity, mean
colour
0.15 dc + 0.5, ln-scale (v / 16 - 10), rotation (x y z bytes; from version 3 on the smallest three of 10 bits, index 3 = w),
harmonics (v - 128) / 128, coefficient by coefficient, channels fastest. Axes are those of `spz_axes`; what this
module returns has those of PLY files, right down front, so that a capture has the same axes whatever file it
comes from. Version 4: a plain header of 32 bytes,
a table of (compressed, raw) sizes, one zstd frame a stream. It needs `zstandard`. Extensions are records of
type, length and payload, where flag 2 is set: before version 4 behind the streams, else before the table. All
are kept.
"""

import itertools
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...rendering.north import Bearings
from ...types import Origin
from ..gaussians import COUNTS, Gaussians, bulk_of, from_arrays
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats
from .spz_axes import (
    PLY_AXES,
    Axes,
    axes_record,
    bearings_record,
    guessed_axes,
    said_axes,
    said_bearings,
)

_MAGIC = 0x5053474E
"""The letters NGSP."""
_SPZ_HEADER = struct.Struct("<IIIBBBB")
"""Magic, version, Gaussians, degree, fractional bits, flags; a byte of 0."""
_WIDE_HEADER = struct.Struct("<IIIBBBBI12x")
"""That of version 4: the last byte is the number of streams, then where their table begins."""
_TABLE_ENTRY = struct.Struct("<QQ")
"""Bytes of a stream, packed and unpacked."""
_ANTIALIASED_FLAG = 1
"""Bit of the flags: opacities are compensated (Mip-Splatting)."""
_EXTENSIONS_FLAG = 2
"""Bit of the flags: extensions follow."""
_MAX_FRACTION = 23
"""Fractional bits of positions at most: of 24 bits one is the sign."""
_MAX_POSITION_STEPS = 2**23 - 1
"""In the steps of positions."""
_MIN_EXTENT = 1e-9
"""Of coordinates, so that the logarithm of steps is finite."""
_MAX_READ_FRACTION = 30
"""Fractional bits beyond it are damage: other programs write 12."""
_MAX_STEP_OF_SPZ = 2.0**-13
"""Steps of positions in extents of the capture, to which outliers do not matter; steps of mm in a room are
finer.
"""
_MAX_STEP_SHARE = 1e-3
"""Steps of positions in extents of the bulk, above which they are said: a pixel of a view of it."""
_LN_SIZE_RANGE = (-10.0, 5.9375)
"""Smallest and largest ln-scale: bytes 0 and 255."""
_LN_SIZE_STEPS = 16
"""A unit of ln-scale."""
_MAX_GZIP_RATIO = 1032
"""Times its size that deflated data may unpack to at most (zlib)."""
_MAX_ZSTD_RATIO = 64
"""The same of positions of version 4, which hardly shrink in captures, and some bytes for small files."""
_ZSTD_SLACK_BYTES = 1 << 16
"""Bytes that a small stream may unpack to beyond that."""
_MAX_TRAILER_BYTES = 1 << 20
"""Bytes behind the streams (extensions) that are kept."""
_PIECE_BYTES = 1 << 12
"""Packed bytes at a time."""
_TINT_SCALE = 0.15
"""Of mean colours: bytes reach harmonics of -3.3 to 3.3."""
_TURN_ORDER = (1, 2, 3, 0)
"""Positions of a file's components x y z w in w x y z."""
_SAMPLED_GAUSSIANS = 20_000
"""As many as tell the ground (`ground.find_ground`)."""


class _Header(NamedTuple):
    version: int
    number: int
    degree: int
    fraction: int
    flags: int
    size: int
    """Bytes before the streams, or before the extensions of version 4."""

    @property
    def sizes(self) -> list[int]:
        """Bytes of each stream: positions, opacities, colours, scales, rotations, harmonics."""
        position = 6 if self.version == 1 else 9
        turn = 4 if self.version >= 3 else 3
        rest = 3 * (COUNTS[self.degree] - 1)
        found: list[int] = []
        for each in (position, 1, 3, 3, turn, rest):
            found.append(self.number * each)
        return found


_TINT_STREAM = 2
"""Number of the stream of mean colours."""
_REST_STREAM = 5
"""Number of that of the other harmonics."""


class _Container(NamedTuple):
    """A file, taken apart."""

    header: _Header
    streams: list[bytes]
    """Unpacked; the last one is empty where there are no harmonics but the constants."""
    extensions: bytes
    """Bytes behind the streams, or before the table of version 4."""
    unpacked: Data
    """The file without gzip."""
    trailer: bytes | None
    """Bytes behind the gzip members; None where the file is not of gzip."""
    frames: list[bytes]
    """Packed streams of version 4."""

    @property
    def axes_records(self) -> bytes:
        """Extensions where the header announces any."""
        if self.header.flags & _EXTENSIONS_FLAG:
            return self.extensions
        return b""

    def with_streams(self, new: Mapping[int, bytes]) -> list[bytes]:
        """The file with other bytes in some streams; what is packed alone stays as it is packed."""
        if self.header.version < 4:
            parts = []
            for number, stream in enumerate(self.streams):
                parts.append(new.get(number, stream))
            whole = b"".join([self.unpacked[: self.header.size], *parts, self.extensions])
            if self.trailer is None:
                return [whole]
            return [zlib.compress(whole, 6, wbits=31), self.trailer]
        import zstandard

        table = self.header.size + len(self.extensions)
        frames = list(self.frames)
        for number, stream in new.items():
            if number < len(frames):
                frames[number] = zstandard.ZstdCompressor().compress(stream)
        entries = []
        for frame, stream in zip(frames, self.streams, strict=False):
            entries.append(_TABLE_ENTRY.pack(len(frame), len(stream)))
        end = table + _TABLE_ENTRY.size * len(frames) + sum(map(len, self.frames))
        return [self.unpacked[:table], *entries, *frames, self.unpacked[end:]]


class _Rows:
    """The Gaussians of a file, of which some rows at a time are decoded."""

    def __init__(self, header: _Header, streams: list[bytes]) -> None:
        count = header.number
        means, opacity, tint, scales, turns, rest = (np.frombuffer(each, np.uint8) for each in streams)
        self.header = header
        self.means = means
        self.opacity = opacity
        self.tint = tint.reshape(count, 3)
        self.scales = scales.reshape(count, 3)
        self.turns = turns
        self.rest = rest.reshape(count, COUNTS[header.degree] - 1, 3)

    def decoded(self, rows: slice, axes: Axes) -> tuple[Floats, ...]:
        """Some of them as `base.decoded` wants them."""
        constants = (self.tint[rows, None] / 255 - 0.5) / _TINT_SCALE
        rest = (self.rest[rows].astype(np.float64) - 128) / 128
        return (
            axes.points(self._points(rows)),
            axes.quaternions(self._quaternions(rows)),
            self.scales[rows] / _LN_SIZE_STEPS + _LN_SIZE_RANGE[0],
            base.logit(self.opacity[rows] / 255),
            axes.harmonics(np.concatenate([constants, rest], 1)),
        )

    def sample(self) -> Gaussians:
        """Some of them in the file's own axes, evenly through the file."""
        step = -(-self.header.number // _SAMPLED_GAUSSIANS)
        some = self.decoded(slice(0, None, max(step, 1)), PLY_AXES)
        return from_arrays(some[0], some[1], some[2], some[3], some[4])

    def _points(self, rows: slice) -> Floats:
        count = self.header.number
        if self.header.version == 1:
            return self.means.view("<f2").reshape(count, 3)[rows].astype(np.float64)
        # 24 bits, the lowest byte first; the highest bit is the sign.
        low, middle, high = self.means.reshape(count, 3, 3)[rows].astype(np.int32).transpose(2, 0, 1)
        steps = ((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000
        return np.asarray(steps / 2.0**self.header.fraction)

    def _quaternions(self, rows: slice) -> Floats:
        if self.header.version < 3:
            three = self.turns.reshape(self.header.number, 3)[rows] / 127.5 - 1
            w = np.sqrt(np.maximum(0, 1 - (three**2).sum(1, keepdims=True)))
            return np.concatenate([w, three], 1)
        word = self.turns.view("<u4")[rows]
        pieces = []
        for shift in (20, 10, 0):
            pieces.append(word >> shift & 1023)
        parts = np.stack(pieces, 1).astype(np.int64)
        sizes = (parts & 511) / 511 * np.where(parts >> 9, -1.0, 1.0)
        found = base.three_to_four((word >> 30).astype(np.int64), sizes)
        quaternions = np.empty_like(found)
        quaternions[:, _TURN_ORDER] = found
        return quaternions

    def recoloured(self, harmonics: Floats, changed: Bools) -> dict[int, bytes]:
        """The streams of colours with other ones [M K 3] for the Gaussians that changed; the others keep
        their bytes.
        """
        tint = self.tint.copy()
        rest = self.rest.copy()
        tint[changed], rest[changed] = _colour_bytes(harmonics)
        return {_TINT_STREAM: tint.tobytes(), _REST_STREAM: rest.tobytes()}


@dataclass(frozen=True, kw_only=True)
class Spz(CaptureFormat):
    """Niantic's .spz, read in versions 1 to 4 and written in version 3."""

    def recognises(self, head: bytes, size: int) -> bool:
        return head.startswith((b"\x1f\x8b", b"NGSP"))

    def read(self, path: Path, data: Data) -> Capture:
        """A .spz file of versions 1 to 4. Raises DataError for others, and for version 4 where `zstandard` is
        not installed.
        """
        file = _container(path, data)
        header = file.header
        rows = _Rows(header, file.streams)
        notes: tuple[str, ...] = ()
        axes = said_axes(path, file.axes_records, header.degree)
        if axes is None:
            axes, reason = guessed_axes(header.version, header.fraction, rows.sample())
            notes = (reason,)

        def part(some: slice) -> tuple[Floats, ...]:
            return rows.decoded(some, axes)

        def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
            new = axes.harmonics(base.finite(harmonics[changed]), back=True)
            return file.with_streams(rows.recoloured(new, changed))

        gaussians, shift = base.decoded(COUNTS[header.degree], (header.number, part))
        antialiased = bool(header.flags & _ANTIALIASED_FLAG)
        capture = Capture(path, gaussians, antialiased, data, recolour, shift=shift, notes=notes)
        said = said_bearings(file.axes_records, axes)
        if said is None:
            return capture
        return base.with_said_bearings(capture, said[0], said[1])

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """Version 3 in the axes of PLY files, which it names, with as many fractional bits as the largest
        coordinate leaves.
        """
        means, turns, scales, logits, harmonics = base.arrays(gaussians)
        fraction = -int(np.log2(_step(means)))
        steps = np.rint(means.astype(np.float64) * 2.0**fraction)
        at = np.clip(steps, -_MAX_POSITION_STEPS - 1, _MAX_POSITION_STEPS).astype(np.int64) & 0xFFFFFF
        ln_sizes = (base.finite(scales) - _LN_SIZE_RANGE[0]) * _LN_SIZE_STEPS
        tint, rest = _colour_bytes(base.finite(harmonics))
        flags = _EXTENSIONS_FLAG | (_ANTIALIASED_FLAG if antialiased else 0)
        parts = [
            _SPZ_HEADER.pack(_MAGIC, 3, len(gaussians), gaussians.degree, fraction, flags, 0),
            np.stack([at & 255, at >> 8 & 255, at >> 16], -1).astype(np.uint8).tobytes(),
            base.steps(base.sigmoid(logits), 255).astype(np.uint8).tobytes(),
            tint.tobytes(),
            np.clip(np.rint(ln_sizes), 0, 255).astype(np.uint8).tobytes(),
            _packed_turns(turns).tobytes(),
            rest.tobytes(),
            axes_record(),
        ]
        return [zlib.compress(b"".join(parts), 6, wbits=31)]

    def with_bearings(self, pieces: Iterable[bytes], bearings: Bearings) -> list[bytes]:
        """With an extension behind that of the axes."""
        whole = zlib.decompress(b"".join(pieces), wbits=31)
        return [zlib.compress(whole + bearings_record(bearings), 6, wbits=31)]

    def keeps(self, gaussians: Gaussians) -> Bools:
        """Those within the reach of 24 bits whose steps suit the bulk."""
        means = gaussians.means.numpy()
        precise = base.precise(means, lambda kept, _: _step(kept), _MAX_STEP_OF_SPZ)
        return np.asarray(precise & (np.abs(means) <= _MAX_POSITION_STEPS).all(1))

    def notes(self, gaussians: Gaussians) -> list[str]:
        means = gaussians.means.numpy()
        largest = gaussians.log_scales.amax(1).numpy()
        step = _step(means)
        side = bulk_of(means).side
        notes = []
        if step > _MAX_STEP_SHARE * side > 0:
            notes.append(
                f"positions in steps of {step:g}, as they lie {float(np.abs(means).max()):.2g} from the origin"
            )
        smallest = _LN_SIZE_RANGE[0] - 0.5 / _LN_SIZE_STEPS
        widest = _LN_SIZE_RANGE[1] + 0.5 / _LN_SIZE_STEPS
        limited = int(((largest < smallest) | (largest > widest)).sum())
        if limited:
            low, high = np.exp(_LN_SIZE_RANGE)
            notes.append(f"{limited} with sizes that .spz limits to {low:.2g} to {high:.3g}")
        return notes


def _step(means: Floats) -> float:
    """Distance between positions that 24 bits tell apart; infinite for those that they do not reach."""
    largest = float(np.abs(means).max(initial=0.0))
    if largest > _MAX_POSITION_STEPS:
        return np.inf
    fraction = np.floor(np.log2(_MAX_POSITION_STEPS / max(largest, _MIN_EXTENT)))
    return float(2.0 ** -np.clip(fraction, 0, _MAX_FRACTION))


def _packed_turns(turns: Floats) -> NDArray[np.uint32]:
    """Rotations [N 4], w x y z, in one word each."""
    largest, three = base.smallest_three(turns.astype(np.float64)[:, _TURN_ORDER])
    # Two bits say which component is left out; each other one has a sign and 9 bits.
    word = largest.astype(np.uint32)
    for column in three.T:
        sign = (column < 0).astype(np.uint32)
        size = base.steps(np.abs(column), 511).astype(np.uint32)
        word = word << 10 | sign << 9 | size
    return word.astype("<u4")


def _container(path: Path, data: Data) -> _Container:
    """The streams of a file, packed together or each alone. Raises DataError where it is damaged."""
    packed = data[:2] == b"\x1f\x8b"
    unpacked = data
    trailer = None
    if packed:
        unpacked, trailer = _unzip(path, data)
    header = _header(path, unpacked)
    if header.version > 3:
        streams, frames, table = _frames(path, data, header)
        return _Container(header, streams, data[header.size : table], data, None, frames)
    ends = np.cumsum([header.size, *header.sizes]).tolist()
    if ends[-1] > len(unpacked):
        state = " unpacked" if packed else ""
        raise base.short(path, len(unpacked), ends[-1], f"{header.number} Gaussians{state}")
    streams = []
    for start, stop in itertools.pairwise(ends):
        streams.append(unpacked[start:stop])
    return _Container(header, streams, unpacked[ends[-1] :], unpacked, trailer, [])


def _colour_bytes(harmonics: Floats) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Constants [N 3] and the other harmonics [N K-1 3] of a file, as it has them."""
    tint = base.steps(harmonics[:, 0] * _TINT_SCALE + 0.5, 255).astype(np.uint8)
    return tint, np.clip(np.rint(harmonics[:, 1:] * 128) + 128, 0, 255).astype(np.uint8)


def _header(path: Path, data: Data) -> _Header:
    if len(data) < _SPZ_HEADER.size:
        raise base.short(path, len(data), _SPZ_HEADER.size, "the header")
    magic, version, count, degree, fraction, flags, _ = _SPZ_HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise DataError(f"{path}: does not begin as a .spz file does; it is damaged or of another kind")
    for what, value, least, most in (
        ("version", version, 1, 4),
        ("degree of harmonics", degree, 0, len(COUNTS) - 1),
        ("number of fractional bits", fraction, 0, _MAX_READ_FRACTION),
    ):
        if not least <= value <= most:
            raise DataError(f"{path}: a .spz whose {what} is {value}; {least} to {most} can be read")
    size = _SPZ_HEADER.size if version < 4 else _WIDE_HEADER.size
    return _Header(version, count, degree, fraction, flags, size)


def _unzip(path: Path, data: Data) -> tuple[bytes, bytes]:
    """Return the content of all members of a gzip file, no more than its header announces, and what lies
    behind them.
    """
    content = bytearray()
    at = 0
    most = _SPZ_HEADER.size
    try:
        while data[at : at + 2] == b"\x1f\x8b":
            packer = zlib.decompressobj(31)
            while not packer.eof and len(content) < most:
                # zlib copies what it leaves of a piece: of the whole file that would take minutes where
                # members are many.
                piece = data[at : at + _PIECE_BYTES]
                got = packer.decompress(piece, most - len(content))
                at += len(piece) - len(packer.unused_data if packer.eof else packer.unconsumed_tail)
                content += got
                if len(content) == most == _SPZ_HEADER.size:  # the header bounds the rest
                    header = _header(path, bytes(content))
                    if header.version > 3:
                        raise DataError(f"{path}: .spz of version 4 within gzip; unpack it first (gunzip)")
                    most += sum(header.sizes) + _MAX_TRAILER_BYTES
                    if sum(header.sizes) > _MAX_GZIP_RATIO * len(data):
                        needed = sum(header.sizes) // _MAX_GZIP_RATIO
                        raise base.short(path, len(data), needed, f"{header.number} Gaussians")
                if not got and not piece and not packer.eof:
                    return bytes(content), b""
            if not packer.eof:
                raise DataError(
                    f"{path}: more than {_MAX_TRAILER_BYTES} bytes behind the Gaussians; it is damaged or of another kind"
                )
    except zlib.error as error:
        if "data check" in str(error):
            reason = "its checksum is another"
        else:
            reason = str(error)
        raise DataError(f"{path}: damaged gzip ({reason}); copy the file again") from error
    return bytes(content), data[at:]


def _frames(path: Path, data: Data, header: _Header) -> tuple[list[bytes], list[bytes], int]:
    """The streams of version 4, unpacked and packed, and where their table begins; harmonics of degree 0 have
    none.
    """
    if len(data) < _WIDE_HEADER.size:
        raise base.short(path, len(data), _WIDE_HEADER.size, "the header")
    *_, count, at = _WIDE_HEADER.unpack_from(data)
    wanted = 5 if header.degree == 0 else 6
    if count != wanted or at < _WIDE_HEADER.size:
        raise DataError(f"{path}: version 4 with {count} streams from byte {at}; there are {wanted}")
    start = at + count * _TABLE_ENTRY.size
    if start > len(data):
        raise base.short(path, len(data), start, "the table of streams")
    sizes = [*_TABLE_ENTRY.iter_unpack(data[at:start])]
    end = start + sum(size for size, _ in sizes)
    if end > len(data):
        raise base.short(path, len(data), end, "the streams")
    # A zstd frame may unpack to anything: positions of captures hardly shrink, so they bound the rest.
    packed, unpacked = sizes[0]
    if unpacked > _MAX_ZSTD_RATIO * packed + _ZSTD_SLACK_BYTES:
        raise base.short(path, packed, unpacked // _MAX_ZSTD_RATIO, f"{header.number} positions")
    try:
        import zstandard as zstd
    except ImportError:
        raise DataError(
            f"{path}: .spz of version 4 is read with zstandard; pip install zstandard, or save as version 3"
        ) from None
    streams = []
    frames = []
    for (size, raw), needed in zip(sizes, header.sizes, strict=False):
        if raw != needed:
            raise DataError(
                f"{path}: a stream of {raw} bytes where {header.number} Gaussians have {needed}; copy it again"
            )
        frames.append(data[start : start + size])
        try:
            streams.append(zstd.ZstdDecompressor().decompress(frames[-1], max_output_size=needed))
        except zstd.ZstdError as error:
            raise DataError(
                f"{path}: a stream that zstd cannot read ({error}); copy the file again"
            ) from error
        if len(streams[-1]) != needed:
            raise base.short(path, len(streams[-1]), needed, "a stream unpacked")
        start += size
    if header.degree == 0:
        streams.append(b"")
    return streams, frames, at
