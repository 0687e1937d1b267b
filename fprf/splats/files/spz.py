"""The .spz file (Niantic): gzip of a 16-byte header and one stream a property (versions 1 to 3), or zstd
streams (version 4).

Streams: positions of 24 bits with a common number of fractional bits (version 1: float16), opacity, mean
colour
0.15 dc + 0.5, ln-scale (v / 16 - 10), rotation (x y z bytes; from version 3 on the smallest three of 10 bits, index 3 = w),
harmonics (v - 128) / 128, coefficient by coefficient, channels fastest. Axes are right up back, or those of
the extension `SPZ_ADOBE_coordinate_system`; what this module returns has those of PLY files, right down
front, so that a capture has the same axes whatever file it comes from. Version 4: a plain header of 32 bytes,
a table of (compressed, raw) sizes, one zstd frame a stream. It needs `zstandard`. Extensions are records of
type, length and payload, where flag 2 is set: before version 4 behind the streams, else before the table. All
are kept.
"""

import itertools
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...types import Origin
from ..gaussians import COUNTS, Gaussians, bulk_of
from . import base
from .base import Bools, Capture, CaptureFormat, Data, Floats

_MAGIC = 0x5053474E
_HEADER = struct.Struct("<IIIBBBB")
_WIDE_HEADER = struct.Struct("<IIIBBBBI12x")
_ENTRY = struct.Struct("<QQ")
_FRACTION = 23
"""Fractional bits of positions at most."""
_PRECISION = 2.0**-13
"""Steps of positions in extents of the capture, to which outliers do not matter; steps of mm in a room are
finer.
"""
_SIZES = (-10.0, 5.9375)
"""Smallest and largest ln-scale."""
_RATIO = 1032
"""Times its size that deflated data may unpack to at most."""
_TRAILER = 1 << 20
"""Bytes behind the streams (extensions) that are kept."""
_PIECE = 1 << 12
"""Packed bytes at a time."""
_TINT = 0.15
_COORDINATES = 0xADBE0003
"""Type of the extension that says which axes a file has; its payload is their number."""
_RUB = 4
_TURN = (1, 2, 3, 0)
"""Where the components x y z w of a file lie in w x y z."""


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
        found: list[int] = []
        for each in (position, 1, 3, 3, turn, 3 * (COUNTS[self.degree] - 1)):
            found.append(self.number * each)
        return found


@dataclass(frozen=True, kw_only=True)
class Spz(CaptureFormat):
    """Niantic's .spz, read in versions 1 to 4 and written in version 3."""

    def recognises(self, head: bytes, size: int) -> bool:
        return head.startswith((b"\x1f\x8b", b"NGSP"))

    def read(self, path: Path, data: Data) -> Capture:
        """A .spz file of versions 1 to 4. Raises DataError for others, and for version 4 where `zstandard` is
        not installed.
        """
        # The streams, packed together or each alone.
        packed = data[:2] == b"\x1f\x8b"
        unpacked, after = _unzip(path, data) if packed else (data, b"")
        header = _header(path, unpacked)
        if header.version < 4:
            ends = np.cumsum([header.size, *header.sizes]).tolist()
            if ends[-1] > len(unpacked):
                raise base.short(
                    path, len(unpacked), ends[-1], f"{header.number} Gaussians{' unpacked' * packed}"
                )
            streams = []
            for start, stop in itertools.pairwise(ends):
                streams.append(unpacked[start:stop])
            extensions = unpacked[ends[-1] :]
        else:
            streams, frames, table = _frames(path, data, header)
            extensions = data[header.size : table]
        axes = _axes(path, extensions if header.flags & 2 else b"", header.degree)
        means, opacity, tint, scales, turns, rest = (np.frombuffer(each, np.uint8) for each in streams)
        count = header.number
        bands = COUNTS[header.degree]

        def part(rows: slice) -> tuple[Floats, ...]:
            # Positions and rotations are stored otherwise in each version; the rest never changed.
            if header.version == 1:
                points: Floats = means.view("<f2").reshape(count, 3)[rows].astype(np.float64)
            else:
                # 24 bits, the lowest byte first; the highest bit is the sign.
                low, middle, high = means.reshape(count, 3, 3)[rows].astype(np.int32).transpose(2, 0, 1)
                points = (((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000) / 2.0**header.fraction
            if header.version < 3:
                three = turns.reshape(count, 3)[rows] / 127.5 - 1
                quaternions = np.concatenate(
                    [np.sqrt(np.maximum(0, 1 - (three**2).sum(1, keepdims=True))), three], 1
                )
            else:
                word = turns.view("<u4")[rows]
                parts = np.stack([word >> shift & 1023 for shift in (20, 10, 0)], 1).astype(np.int64)
                found = base.three_to_four(
                    (word >> 30).astype(np.int64), (parts & 511) / 511 * np.where(parts >> 9, -1.0, 1.0)
                )
                quaternions = np.empty_like(found)
                quaternions[:, _TURN] = found
            constants = (tint.reshape(count, 1, 3)[rows] / 255 - 0.5) / _TINT
            bits = rest.reshape(count, bands - 1, 3)[rows].astype(np.float64)
            return (
                axes.points(points),
                axes.quaternions(quaternions),
                scales.reshape(count, 3)[rows] / 16 - 10,
                base.logit(opacity[rows] / 255),
                axes.harmonics(np.concatenate([constants, (bits - 128) / 128], 1)),
            )

        def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
            # Bytes of Gaussians that did not change stay as they are.
            colours = (tint.reshape(count, 3).copy(), rest.reshape(count, bands - 1, 3).copy())
            new_bytes = _colour_bytes(axes.harmonics(base.finite(harmonics[changed]), back=True))
            for stream, bytes_ in zip(colours, new_bytes, strict=True):
                stream[changed] = bytes_
            new = dict(zip((2, 5), (stream.tobytes() for stream in colours), strict=True))
            if header.version > 3:  # the other streams stay as they are packed
                import zstandard

                pack = zstandard.ZstdCompressor().compress
                again = []
                for k, frame in enumerate(frames):
                    again.append(pack(new[k]) if k in new else frame)
                entries = []
                for frame, each in zip(again, streams, strict=False):
                    entries.append(_ENTRY.pack(len(frame), len(each)))
                end = table + sum(map(len, frames)) + len(b"".join(entries))
                return [data[:table], *entries, *again, data[end:]]
            parts = [new.get(i, each) for i, each in enumerate(streams)]
            whole = b"".join([unpacked[: header.size], *parts, extensions])
            if packed:
                return [zlib.compress(whole, 6, wbits=31), after]
            return [whole]

        gaussians, shift = base.decoded(bands, (count, part))
        return Capture(path, gaussians, bool(header.flags & 1), data, recolour, shift=shift)

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> list[bytes]:
        """Version 3, with as many fractional bits as the largest coordinate leaves."""
        means, turns, scales, logits, harmonics = base.arrays(gaussians)
        axes = _Axes(False, (1.0, -1.0, -1.0))
        fraction = -int(np.log2(_step(means)))
        points = axes.points(means.astype(np.float64)) * 2.0**fraction
        at = np.clip(np.rint(points), -(2**23), 2**23 - 1).astype(np.int64) & 0xFFFFFF
        most, three = base.smallest_three(axes.quaternions(turns.astype(np.float64))[:, _TURN])
        # Two bits say which component is left out; each other one has a sign and 9 bits.
        word = most.astype(np.uint32)
        for column in three.T:
            word = (
                word << 10
                | (column < 0).astype(np.uint32) << 9
                | base.steps(np.abs(column), 511).astype(np.uint32)
            )
        tint, rest = _colour_bytes(axes.harmonics(base.finite(harmonics)))
        parts = [
            _HEADER.pack(_MAGIC, 3, len(gaussians), gaussians.degree, fraction, int(antialiased), 0),
            np.stack([at & 255, at >> 8 & 255, at >> 16], -1).astype(np.uint8).tobytes(),
            base.steps(base.sigmoid(logits), 255).astype(np.uint8).tobytes(),
            tint.tobytes(),
            np.clip(np.rint((base.finite(scales) + 10) * 16), 0, 255).astype(np.uint8).tobytes(),
            word.astype("<u4").tobytes(),
            rest.tobytes(),
        ]
        return [zlib.compress(b"".join(parts), 6, wbits=31)]

    def keeps(self, gaussians: Gaussians) -> Bools:
        """Those within the reach of 24 bits whose steps suit the bulk."""
        means = gaussians.means.numpy()
        return np.asarray(
            base.precise(means, lambda kept, _: _step(kept), _PRECISION) & (np.abs(means) <= 2**23 - 1).all(1)
        )

    def notes(self, gaussians: Gaussians) -> list[str]:
        means = gaussians.means.numpy()
        largest = gaussians.log_scales.amax(1).numpy()
        step = _step(means)
        side = bulk_of(means).side
        notes = []
        if step > 1e-3 * side > 0:
            notes.append(
                f"positions in steps of {step:g}, as they lie {float(np.abs(means).max()):.2g} from the origin"
            )
        limited = int(((largest < _SIZES[0] - 1 / 32) | (largest > _SIZES[1] + 1 / 32)).sum())
        if limited:
            notes.append(
                f"{limited} with sizes that .spz limits to {np.exp(_SIZES[0]):.2g} to {np.exp(_SIZES[1]):.3g}"
            )
        return notes


def _step(means: Floats) -> float:
    """Distance between positions that 24 bits tell apart; infinite for those that they do not reach."""
    largest = float(np.abs(means).max(initial=0.0))
    if largest > 2**23 - 1:
        return np.inf
    return float(2.0 ** -np.clip(np.floor(np.log2((2**23 - 1) / max(largest, 1e-9))), 0, _FRACTION))


class _Axes(NamedTuple):
    """The axes of a file, against right down front: turned by 90 degrees about x, then mirrored."""

    turned: bool
    """z is up or down, y front or back."""
    signs: tuple[float, float, float]

    def points(self, points: Floats) -> Floats:
        """Points [N 3] of a file, right down front."""
        if self.turned:
            points = np.stack([points[:, 0], points[:, 2], -points[:, 1]], 1)
        return np.asarray(points * np.array(self.signs))

    def quaternions(self, turns: Floats) -> Floats:
        """Rotations [N 4], w x y z, as `points`. Mirroring the world and the own axes of a Gaussian leaves
        its shape.
        """
        if self.turned:
            w, x, y, z = turns.T * 0.5**0.5
            turns = np.stack([w + x, x - w, y + z, z - y], 1)
        a, b, c = self.signs
        return np.asarray(turns * np.array([1.0, b * c, a * c, a * b]))

    def harmonics(self, harmonics: Floats, back: bool = False) -> Floats:
        """Harmonics [N K 3] as `points`; `back`: those of a file."""
        bands = harmonics.shape[1]
        degree = np.sqrt(np.arange(bands)).astype(np.int64)
        order = np.arange(bands) - degree * (degree + 1)
        odd = np.where(order < 0, -1.0, 1.0)  # those of negative order have the sign of y
        flips = (odd * (-1.0) ** order, odd, (-1.0) ** (degree + order))
        parity = np.prod(
            [flip if sign < 0 else np.ones(bands) for flip, sign in zip(flips, self.signs, strict=True)], 0
        )
        if not self.turned:
            return np.asarray(harmonics * parity[:, None])
        turn = base.turned_harmonics(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), bands)
        matrix = parity[:, None] * turn
        return np.asarray(np.matmul(matrix.T if back else matrix, harmonics))


def _axes(path: Path, extensions: bytes, degree: int) -> _Axes:
    """The axes that a record `SPZ_ADOBE_coordinate_system` names by its number, else right up back."""
    number = _RUB
    at = 0
    while at + 12 <= len(extensions):
        kind, size, value = struct.unpack_from("<III", extensions, at)
        if kind == _COORDINATES and size == 4:
            number = value or _RUB
            break
        at += 8 + size
    if number > 16:
        raise DataError(f"{path}: axes of number {number} (SPZ_ADOBE_coordinate_system); 1 to 16 are known")
    # Right, up and front are bits, another one swaps y and z.
    right, up, front, turned = (number - 1 >> k & 1 for k in range(4))
    if turned and degree > 3:
        raise DataError(
            f"{path}: harmonics of degree 4 with z up or down; save the file with y up, or with degree 3"
        )
    x = 2.0 * right - 1
    down = 1 - 2.0 * up
    ahead = 2.0 * front - 1
    # Turned, a point of right front up is (x, z, -y), and of right down front (x, -z, y).
    if turned:
        return _Axes(True, (x, down, -ahead))
    return _Axes(False, (x, down, ahead))


def _colour_bytes(harmonics: Floats) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Constants [N 3] and the other harmonics [N K-1 3] of a file, as it has them."""
    tint = base.steps(harmonics[:, 0] * _TINT + 0.5, 255).astype(np.uint8)
    return tint, np.clip(np.rint(harmonics[:, 1:] * 128) + 128, 0, 255).astype(np.uint8)


def _header(path: Path, data: Data) -> _Header:
    if len(data) < _HEADER.size:
        raise base.short(path, len(data), _HEADER.size, "the header")
    magic, version, count, degree, fraction, flags, _ = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise DataError(f"{path}: does not begin as a .spz file does; it is damaged or of another kind")
    for what, value, least, most in (
        ("version", version, 1, 4),
        ("degree of harmonics", degree, 0, len(COUNTS) - 1),
        ("number of fractional bits", fraction, 0, 30),
    ):
        if not least <= value <= most:
            raise DataError(f"{path}: a .spz whose {what} is {value}; {least} to {most} can be read")
    return _Header(
        version, count, degree, fraction, flags, _HEADER.size if version < 4 else _WIDE_HEADER.size
    )


def _unzip(path: Path, data: Data) -> tuple[bytes, bytes]:
    """Return the content of all members of a gzip file, no more than its header announces, and what lies
    behind them.
    """
    content = bytearray()
    at = 0
    most = _HEADER.size
    try:
        while data[at : at + 2] == b"\x1f\x8b":
            packer = zlib.decompressobj(31)
            while not packer.eof and len(content) < most:
                # zlib copies what it leaves of a piece: of the whole file that would take minutes where
                # members are many.
                piece = data[at : at + _PIECE]
                got = packer.decompress(piece, most - len(content))
                at += len(piece) - len(packer.unused_data if packer.eof else packer.unconsumed_tail)
                content += got
                if len(content) == most == _HEADER.size:  # the header bounds the rest
                    header = _header(path, bytes(content))
                    if header.version > 3:
                        raise DataError(f"{path}: .spz of version 4 within gzip; unpack it first (gunzip)")
                    most += sum(header.sizes) + _TRAILER
                    if sum(header.sizes) > _RATIO * len(data):
                        raise base.short(
                            path, len(data), sum(header.sizes) // _RATIO, f"{header.number} Gaussians"
                        )
                if not got and not piece and not packer.eof:
                    return bytes(content), b""
            if not packer.eof:
                raise DataError(
                    f"{path}: more than {_TRAILER} bytes behind the Gaussians; it is damaged or of another kind"
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
    start = at + count * _ENTRY.size
    if start > len(data):
        raise base.short(path, len(data), start, "the table of streams")
    sizes = [*_ENTRY.iter_unpack(data[at:start])]
    end = start + sum(size for size, _ in sizes)
    if end > len(data):
        raise base.short(path, len(data), end, "the streams")
    # A zstd frame may unpack to anything: positions of captures hardly shrink, so they bound the rest.
    if sizes[0][1] > 64 * sizes[0][0] + (1 << 16):
        raise base.short(path, sizes[0][0], sizes[0][1] // 64, f"{header.number} positions")
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
    return ([*streams, b""] if header.degree == 0 else streams), frames, at
