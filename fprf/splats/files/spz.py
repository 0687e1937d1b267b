"""The .spz file (Niantic): gzip of a 16-byte header and one stream a property (versions 1 to 3), or zstd streams (version 4).

Streams: positions of 24 bits with a common number of fractional bits (version 1: float16), opacity, mean colour
0.15 dc + 0.5, ln-scale (v / 16 - 10), rotation (x y z bytes; from version 3 on the smallest three of 10 bits, index 3 = w),
harmonics (v - 128) / 128, coefficient by coefficient, channels fastest. Axes are right up back; what this module returns has
those of PLY files, right down front, so that a capture has the same axes whatever file it comes from.
Version 4: a plain header of 32 bytes, a table of (compressed, raw) sizes, one zstd frame a stream. It needs `zstandard`.
"""

import itertools
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ..gaussians import COUNTS, Gaussians, from_arrays
from .base import Bools, Capture, Floats, centred, finite, logit, short, sigmoid, smallest_three, steps, three_to_four

_MAGIC = 0x5053474E
_HEADER, _WIDE_HEADER = struct.Struct("<IIIBBBB"), struct.Struct("<IIIBBBBI12x")
_ENTRY = struct.Struct("<QQ")
_RATIO = 1032
"""Times its size that deflated data may unpack to at most."""
_TRAILER = 1 << 20
"""Bytes behind the streams (extensions) that are kept."""
_TINT = 0.15
_AXES = np.array([1.0, -1.0, -1.0])
# Signs of the harmonics, band by band, where y and z change theirs.
_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, 1, -1, 1], np.float64)
_TURN = (1, 2, 3, 0)
"""Where the components x y z w of a file lie in w x y z."""


class _Header(NamedTuple):
    version: int
    number: int
    degree: int
    fraction: int
    flags: int

    @property
    def sizes(self) -> list[int]:
        """Bytes of each stream: positions, opacities, colours, scales, rotations, harmonics."""
        position, turn = 6 if self.version == 1 else 9, 4 if self.version >= 3 else 3
        return [self.number * each for each in (position, 1, 3, 3, turn, 3 * (COUNTS[self.degree] - 1))]


def read_spz(path: Path, data: bytes) -> Capture:
    """A .spz file of versions 1 to 4. Raises DataError for others, and for version 4 where `zstandard` is not installed."""
    packed = data[:2] == b"\x1f\x8b"
    if packed:
        unpacked = _unzip(path, data)
        header = _header(path, unpacked)
        ends = np.cumsum([_HEADER.size, *header.sizes]).tolist()
        streams = [unpacked[start:stop] for start, stop in itertools.pairwise(ends)]
    else:
        header = _header(path, data)
        streams = _frames(path, data, header)
    means, opacity, tint, scales, turns, rest = (np.frombuffer(each, np.uint8) for each in streams)
    count, bands = header.number, COUNTS[header.degree]
    if header.version == 1:
        points: Floats = means.view("<f2").reshape(count, 3).astype(np.float64)
    else:
        low, middle, high = means.reshape(count, 3, 3).astype(np.int32).transpose(2, 0, 1)
        points = (((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000) / 2.0**header.fraction
    if header.version < 3:
        three = turns.reshape(count, 3) / 127.5 - 1
        quaternions = np.concatenate([np.sqrt(np.maximum(0, 1 - (three**2).sum(1, keepdims=True))), three], 1)
    else:
        word = turns.view("<u4")
        parts = np.stack([word >> shift & 1023 for shift in (20, 10, 0)], 1).astype(np.int64)
        found = three_to_four((word >> 30).astype(np.int64), (parts & 511) / 511 * np.where(parts >> 9, -1.0, 1.0))
        quaternions = np.empty_like(found)
        quaternions[:, _TURN] = found
    bits = rest.reshape(count, bands - 1, 3).astype(np.float64)
    harmonics = np.concatenate([(tint.reshape(count, 1, 3) / 255 - 0.5) / _TINT, (bits - 128) / 128], 1)
    points, shift = centred(points * _AXES)
    gaussians = from_arrays(
        points,
        quaternions * np.concatenate([[1.0], _AXES]),
        scales.reshape(count, 3) / 16 - 10,
        logit(opacity / 255),
        harmonics * _SIGNS[:bands, None],
    )

    def recolour(harmonics: Floats, changed: Bools) -> bytes:
        colours = (tint.reshape(count, 3).copy(), rest.reshape(count, bands - 1, 3).copy())
        for stream, bytes_ in zip(colours, _colour_bytes(harmonics[changed]), strict=True):
            stream[changed] = bytes_
        new = dict(zip((2, 5), (stream.tobytes() for stream in colours), strict=True))
        if not packed:
            return _framed(path, data, header, new)
        parts = [new.get(i, each) for i, each in enumerate(streams)]
        return _zipped(b"".join([unpacked[: _HEADER.size], *parts, unpacked[ends[-1] :]]))

    return Capture(path, gaussians, bool(header.flags & 1), data, recolour, shift)


def spz_bytes(gaussians: Gaussians, antialiased: bool) -> bytes:
    """A file of version 3, with as many fractional bits as the largest coordinate leaves."""
    means = finite(gaussians.means.numpy()) * _AXES
    largest = float(np.abs(means).max(initial=0.0))
    fraction = int(np.clip(np.floor(np.log2((2**23 - 1) / max(largest, 2.0**-10))), 0, 23))
    at = np.clip(np.rint(means * 2.0**fraction), -(2**23), 2**23 - 1).astype(np.int64) & 0xFFFFFF
    turn = (gaussians.quaternions.numpy() * np.concatenate([[1.0], _AXES]))[:, _TURN]
    most, three = smallest_three(_whole(turn))
    word = most.astype(np.uint32)
    for column in three.T:
        word = word << 10 | (column < 0).astype(np.uint32) << 9 | steps(np.abs(column), 511).astype(np.uint32)
    tint, rest = _colour_bytes(gaussians.harmonics.numpy())
    flags = 1 if antialiased else 0
    parts = [
        _HEADER.pack(_MAGIC, 3, len(gaussians), gaussians.degree, fraction, flags, 0),
        np.stack([at & 255, at >> 8 & 255, at >> 16], -1).astype(np.uint8).tobytes(),
        steps(sigmoid(gaussians.logits.numpy()), 255).astype(np.uint8).tobytes(),
        tint.tobytes(),
        np.clip(np.rint((finite(gaussians.log_scales.numpy()) + 10) * 16), 0, 255).astype(np.uint8).tobytes(),
        word.astype("<u4").tobytes(),
        rest.tobytes(),
    ]
    return _zipped(b"".join(parts))


def _whole(turn: Floats) -> Floats:
    """Quaternions x y z w; those without a length become the identity, whose w comes last here."""
    none = ~(np.isfinite(turn).all(1) & (np.abs(turn).max(1) > 0))
    return np.where(none[:, None], [0.0, 0.0, 0.0, 1.0], turn)


def _colour_bytes(harmonics: Floats) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Constants [N 3] and the other harmonics [N K-1 3] as a file has them."""
    turned = finite(harmonics) * _SIGNS[: harmonics.shape[1], None]
    tint = steps(turned[:, 0] * _TINT + 0.5, 255).astype(np.uint8)
    return tint, np.clip(np.rint(turned[:, 1:] * 128) + 128, 0, 255).astype(np.uint8)


def _header(path: Path, data: bytes) -> _Header:
    if len(data) < _HEADER.size:
        raise short(path, len(data), _HEADER.size, "the header")
    magic, version, count, degree, fraction, flags, _ = _HEADER.unpack_from(data)
    if magic != _MAGIC or not 1 <= version <= 4 or degree >= len(COUNTS) or fraction > 30:
        raise DataError(
            f"{path}: no .spz header of versions 1 to 4 (version {version}, harmonics of degree {degree}, {fraction} "
            "fractional bits); the file is damaged or of another kind"
        )
    return _Header(version, count, degree, fraction, flags)


def _unzip(path: Path, data: bytes) -> bytes:
    """Return the content of a gzip file: the header first, then no more than that announces."""
    try:
        head = zlib.decompressobj(31).decompress(data, _HEADER.size)
        header = _header(path, head)
        needs = _HEADER.size + sum(header.sizes)
        if header.version > 3 or needs > _RATIO * len(data):
            raise short(path, len(data), needs // _RATIO, f"{header.number} Gaussians of version {header.version}")
        unpacked = zlib.decompressobj(31).decompress(data, needs + _TRAILER)
    except zlib.error as error:
        raise DataError(f"{path}: no readable gzip ({error}); copy the file again") from error
    if len(unpacked) < needs:
        raise short(path, len(unpacked), needs, f"{header.number} Gaussians unpacked")
    return unpacked


def _zipped(data: bytes) -> bytes:
    packer = zlib.compressobj(6, wbits=31)
    return packer.compress(data) + packer.flush()


def _frames(path: Path, data: bytes, header: _Header) -> list[bytes]:
    """The streams of version 4; harmonics of degree 0 have none."""
    from_, sizes = _toc(path, data, header)
    try:
        import zstandard as zstd
    except ImportError:
        raise DataError(
            f"{path}: .spz of version 4 is read with zstandard; pip install zstandard, or save as version 3"
        ) from None
    streams = []
    for (size, raw), wanted in zip(sizes, header.sizes, strict=False):
        if raw != wanted:
            raise DataError(f"{path}: a stream of {raw} bytes where {header.number} Gaussians have {wanted}; copy it again")
        try:
            streams.append(zstd.ZstdDecompressor().decompress(data[from_ : from_ + size], max_output_size=wanted))
        except zstd.ZstdError as error:
            raise DataError(f"{path}: a stream that zstd cannot read ({error}); copy the file again") from error
        if len(streams[-1]) != wanted:
            raise short(path, len(streams[-1]), wanted, "a stream unpacked")
        from_ += size
    return [*streams, b""] if header.degree == 0 else streams


def _toc(path: Path, data: bytes, header: _Header) -> tuple[int, list[tuple[int, int]]]:
    """Return the starts of the streams, and their packed and raw sizes."""
    if len(data) < _WIDE_HEADER.size:
        raise short(path, len(data), _WIDE_HEADER.size, "the header")
    *_, count, at = _WIDE_HEADER.unpack_from(data)
    wanted = 5 if header.degree == 0 else 6
    if header.version != 4 or count != wanted or at < _WIDE_HEADER.size:
        raise DataError(f"{path}: version {header.version} with {count} streams from byte {at}; version 4 has {wanted}")
    end = at + count * _ENTRY.size
    if end > len(data):
        raise short(path, len(data), end, "the table of streams")
    sizes = [_ENTRY.unpack_from(data, at + k * _ENTRY.size) for k in range(count)]
    if end + sum(size for size, _ in sizes) > len(data):
        raise short(path, len(data), end + sum(size for size, _ in sizes), "the streams")
    # A zstd frame may unpack to anything: positions of captures hardly shrink, so they bound the rest.
    if sizes[0][1] > 64 * sizes[0][0] + (1 << 16):
        raise short(path, sizes[0][0], sizes[0][1] // 64, f"{header.number} positions")
    return end, sizes


def _framed(path: Path, data: bytes, header: _Header, new: Mapping[int, bytes]) -> bytes:
    """A file of version 4 with new streams; the others stay as they are packed."""
    import zstandard

    start, sizes = _toc(path, data, header)
    head, frames = data[: start - len(sizes) * _ENTRY.size], []
    for k, (size, _) in enumerate(sizes):
        frames.append(zstandard.ZstdCompressor().compress(new[k]) if k in new else data[start : start + size])
        start += size
    table = b"".join(_ENTRY.pack(len(frame), raw) for frame, (_, raw) in zip(frames, sizes, strict=True))
    return b"".join([head, table, *frames, data[start:]])
