"""The base of file formats of 3D Gaussians, what a reader returns, and what formats share: rounding,
rotations, outliers.

To add a format: a subclass of `CaptureFormat` in a file of this folder, and its entry point in the group
`fprf.captures`. The name of the entry point is the ending of its files: `sog` stands for *.sog; of several
that fit, the longest is meant. N Gaussians · K harmonics a colour channel. Arrays are NumPy's.

A reader never allocates on a file's word: what a header claims is held against the size of the file.
"""

import mmap
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...io.atomic import atomic_path
from ...ops.harmonics import HARMONIC, spherical_harmonics
from ...plugins import registry
from ...plugins.captures import CAPTURES, endings, format_name
from ...plugins.config import PluginConfig
from ...rendering.cameras import Cameras
from ...rendering.local_frame import local_origin
from ...rendering.north import Bearings, North
from ...types import Origin
from ..activation import Activation
from ..gaussians import GaussianRows, Gaussians, bulk_of, from_arrays, morton_order

Data: TypeAlias = bytes | mmap.mmap
"""The content of a file: large ones are mapped. Both are sliced into bytes, and read by np.frombuffer."""
Floats: TypeAlias = NDArray[Any]
Bools: TypeAlias = NDArray[np.bool_]
Recolour: TypeAlias = Callable[[Floats, Bools], Iterable[bytes]]

ROWS = 1 << 17
"""Gaussians that are decoded or encoded at a time, so that the intermediate arrays of large files stay
small.
"""
OWN_KEY = "fprf"
"""Key of what fprf adds to documents of formats that have no place for it: where north and up are."""
UNSOUND = (LookupError, TypeError, ValueError, AttributeError, RecursionError, OverflowError, struct.error)
"""Errors that a document raises, as it is taken apart, that is no valid index of a format."""
_MIN_OPACITY_MARGIN = 1e-6
"""Opacities of exactly 0 and 1 have no logit: both keep this distance, far below a 16-bit step."""
_MAX_MAGNITUDE = 64.0
"""Of harmonics and ln-scales that are written: far beyond what is seen, and no number spoils the others."""
_MIN_OUTLIER_DISTANCE = 4.0
"""Extents of the bulk from it, from which on Gaussians are ordered and bounded apart from it (by eye)."""
_MAX_ROUNDING_OF_TURNS = 1e-9
"""Of numbers that are solved for, from whole ones: turns by right angles and mirrorings are whole, exactly."""
_ORDER_CELLS = 1024
"""Along a side of the grid of spatial order: what a Morton code of 30 bits holds."""
_OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Of the four components of a quaternion those that are stored, by the one that is not."""


@dataclass(frozen=True, eq=False)
class Capture:
    """A file of Gaussians, as it was read."""

    path: Path
    gaussians: Gaussians
    antialiased: bool
    """Trained with opacities compensated for the width that drawing adds (Mip-Splatting)."""
    data: Data
    """The file; large ones are mapped, not in memory. Of a folder, its files as one archive."""
    recolour: Recolour
    """The file, in pieces, with the harmonics [N K 3] of some Gaussians (bool [N]) replaced and everything
    else as it was.
    """
    up: tuple[float, float, float] | None = None
    """Direction that points up, where the file says so, or its format."""
    up_reason: str = ""
    """Source of that, as a phrase."""
    north: North | None = None
    """Direction of north, if the file says it."""
    camera: Cameras | None = None
    """The view that the capture was made from, where the file holds it."""
    shift: Origin = (0.0, 0.0, 0.0)
    """Offset taken off the file's coordinates, which lie far from 0."""
    offset: Origin = (0.0, 0.0, 0.0)
    """Offset that a file beside it adds to them (see `rendering.local_frame`)."""
    notes: tuple[str, ...] = ()
    """Choices where the file could mean two things, each as a sentence."""
    activation: Activation = Activation()
    """Numbers that look activated already, and were not read so."""

    @property
    def origin(self) -> Origin:
        """Of the local frame that the Gaussians are in."""
        return self.shift[0] + self.offset[0], self.shift[1] + self.offset[1], self.shift[2] + self.offset[2]


@dataclass(frozen=True, kw_only=True)
class CaptureFormat(PluginConfig):
    """A format of files of 3D Gaussians. It has no state: there is nothing to build."""

    group: ClassVar[str] = CAPTURES

    view_dependent: ClassVar[bool] = True
    """It holds harmonics, and whether opacities are compensated for antialiasing. Where it does not, it is
    given the mean colours and opacities that views show.
    """
    writes: ClassVar[bool] = True
    """False = files of it are read alone, and what was read from them is written as another format."""
    reads: ClassVar[bool] = True
    """False = files of it are written alone."""
    exact: ClassVar[bool] = False
    """It holds every number as it is, NaN too, and positions in float64. Where it does not, it is given
    Gaussians that can be drawn, about a local origin that stands in a file beside.
    """

    def recognises(self, head: bytes, size: int) -> bool:
        """False where a file of `size` bytes that begin with `head` is certainly damaged or of another
        format.
        """
        raise NotImplementedError

    def read(self, path: Path, data: Data) -> Capture:
        """The Gaussians of a file, and how to recolour it. Raises DataError for anything else than a sound
        file.
        """
        raise NotImplementedError

    def pack(self, gaussians: Gaussians, antialiased: bool, origin: Origin) -> Iterable[bytes]:
        """The file of these Gaussians, on the CPU, in pieces. `origin` is to be added to their positions; 0
        unless `exact`.
        """
        raise DataError(
            f"{type(self).__name__}: files of this format are read, not written; name a .ply, .spz, .sog or .glb"
        )

    def pack_rows(self, rows: GaussianRows, origin: Origin) -> Iterable[bytes]:
        """`pack` of Gaussians that need not all be in memory."""
        return self.pack(rows.part(slice(0, rows.count)), rows.antialiased, origin)

    def with_bearings(self, pieces: Iterable[bytes], bearings: Bearings) -> Iterable[bytes]:
        """A file as `pack` gave it that also says where north and up are; as it is where the format has no place for
        that. `read` returns them.
        """
        return pieces

    def keeps(self, gaussians: Gaussians) -> NDArray[np.bool_] | None:
        """Gaussians [N] that a file holds: all but outliers that would cost the others their precision; None
        = all.
        """
        return None

    def notes(self, gaussians: Gaussians) -> list[str]:
        """Further limits of a file of them, each as a phrase."""
        return []

    def holds(self, capture: Capture, read_as: "CaptureFormat") -> bool:
        """True where a capture's own file, recoloured, is a file of this format."""
        return self.writes and self.reads and type(read_as) is type(self)

    def write(self, path: Path, pieces: Iterable[bytes]) -> None:
        """Write what `pack` or `Capture.recolour` gave, whole or not at all."""
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.writelines(pieces)


def format_of(path: Path) -> CaptureFormat:
    """The format of a file by its name. Raises DataError where it is of none, PluginError where that cannot
    be loaded.
    """
    name = format_name(path)
    if name is None:
        raise DataError(
            f"{path}: no file of Gaussians by its name; known endings are {', '.join(endings())}, or meta.json of a SOG folder"
        )
    return registry.make(CaptureFormat.group, name, CaptureFormat)


def check_needs(form: CaptureFormat) -> None:
    """Raise DataError where a package that writes files of a format is missing."""
    for need in form.needs():
        raise DataError(
            f"{type(form).__name__.lower()}: files of this format are written by {need.what}; {need.remedy}"
        )


def pieces(count: int) -> Iterator[slice]:
    """Rows 0 to `count` in slices of at most `ROWS`."""
    for start in range(0, count, ROWS):
        yield slice(start, min(start + ROWS, count))


def decoded(
    bands: int, *sections: tuple[int, Callable[[slice], tuple[Floats, ...]]]
) -> tuple[Gaussians, Origin]:
    """Gaussians about their local origin, and that: decoded piece by piece.

    Each section has a number of rows and a function that gives means [n 3], quaternions [n 4], ln-scales [n
    3], logits [n] and harmonics [n K 3] of some of them, of any type.
    """
    count = sum(number for number, _ in sections)
    start = 0
    shapes = ((count, 4), (count, 3), (count,), (count, bands, 3))
    parts: list[Floats] = [np.empty((count, 3)), *(np.empty(shape, np.float32) for shape in shapes)]
    for number, part in sections:
        for rows in pieces(number):
            for whole, some in zip(parts, part(rows), strict=True):
                whole[start + rows.start : start + rows.stop] = some
        start += number
    # Positions are float64 until their origin is taken off: float32 would round those far from 0.
    shift = local_origin(torch.from_numpy(parts[0]))
    parts[0] -= shift
    return from_arrays(parts[0], parts[1], parts[2], parts[3], parts[4]), shift


def in_world(table: NDArray[np.void], local: Floats, origin: Origin) -> NDArray[np.void]:
    """Rows with local x y z [N 3] about an origin as float64 of the world; as they are where the origin is
    0.
    """
    if not any(origin):
        return table
    kinds: list[tuple[str, Any]] = []
    for name in table.dtype.names or ():
        kinds.append((name, table.dtype[name]))
    in_float64 = []
    for name, kind in kinds:
        in_float64.append((name, "<f8" if name in ("x", "y", "z") else kind))
    out = table.astype(in_float64)
    for name, column, of in zip("xyz", local.astype(np.float64).T, origin, strict=True):
        out[name] = column + of
    return out


def beside(path: Path, name: str) -> bytes:
    """The content of a file in the folder of another one that names it, or below. Raises DataError where
    there is none.
    """
    file = path.parent / name
    try:
        if not file.resolve().is_relative_to(path.parent.resolve()):
            raise DataError(f"{path}: {name!r} is no file beside it; export the capture again")
        return file.read_bytes()
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {name} beside it cannot be read; copy the whole folder") from error


def direction_of(numbers: object) -> tuple[float, float, float] | None:
    """A direction of length 1 that a file names by three numbers; None for what is none."""
    try:
        vector = np.array(numbers, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if vector.shape != (3,) or not np.isfinite(vector).all() or not np.abs(vector).max() > 0:
        return None
    vector = vector / np.abs(vector).max()
    x, y, z = (vector / np.linalg.norm(vector)).tolist()
    return x, y, z


def with_said_bearings(capture: Capture, north: object, up: object) -> Capture:
    """A capture with the directions that its file names, each by three numbers."""
    there = direction_of(north)
    if there is None:
        return capture
    above = direction_of(up)
    reason = "" if above is None else "the file says so"
    return replace(
        capture, north=North(direction=there, source="the file says so"), up=above, up_reason=reason
    )


def release(data: Data) -> None:
    """Let go of the memory of a mapped file that was read through; it is read again where it is asked for."""
    if isinstance(data, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        data.madvise(mmap.MADV_DONTNEED)


def arrays(gaussians: Gaussians) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Means [N 3], quaternions [N 4], ln-scales [N 3], logits [N] and harmonics [N K 3]."""
    return (
        gaussians.means.detach().cpu().numpy(),
        gaussians.quaternions.detach().cpu().numpy(),
        gaussians.log_scales.detach().cpu().numpy(),
        gaussians.logits.detach().cpu().numpy(),
        gaussians.harmonics.detach().cpu().numpy(),
    )


def short(path: Path, has: int, needs: int, what: str) -> DataError:
    """The error for a file that holds less than its header says."""
    return DataError(
        f"{path}: {what} takes {needs} bytes, but the file has {has}; copy it again, it is cut off or damaged"
    )


def steps(values: Floats, most: int) -> NDArray[np.int64]:
    """Values in [0, 1] as integers 0 to `most`, rounded; what lies outside is clipped, NaN becomes 0."""
    return np.rint(np.clip(np.nan_to_num(values.astype(np.float64), nan=0.0), 0, 1) * most).astype(np.int64)


def pack_bits(shares: Floats, bits: Sequence[int]) -> NDArray[np.int64]:
    """Columns in [0, 1] in one word each row, the first one highest."""
    word = np.zeros(len(shares), np.int64)
    for column, width in zip(shares.T, bits, strict=True):
        word = word << width | steps(column, (1 << width) - 1)
    return word


def unpack_bits(word: NDArray[np.uint32], bits: Sequence[int]) -> Floats:
    """The columns of `pack_bits`, in [0, 1]."""
    columns = []
    shift = 0
    for width in reversed(bits):
        most = (1 << width) - 1
        columns.append((word >> shift & most) / most)
        shift += width
    return np.stack(columns[::-1], 1)


def shares(values: Floats, low: Floats, high: Floats) -> Floats:
    """Place of values between bounds: 0 to 1, and 0 where the bounds are one."""
    span = np.asarray(high - low, np.float64)  # as exact as the bounds are stored
    return np.where(span > 0, (values - low) / np.where(span > 0, span, 1.0), 0.0)


def finite(values: Floats, most: float = _MAX_MAGNITUDE) -> NDArray[np.float64]:
    """Numbers in float64, 0 for NaN, limited to a magnitude."""
    return np.clip(np.nan_to_num(values.astype(np.float64)), -most, most)


def sigmoid(x: Floats) -> Floats:
    """In [0, 1], without overflow."""
    return 0.5 * (1 + np.tanh(0.5 * x))


def logit(opacity: Floats) -> Floats:
    """The inverse of the sigmoid, finite."""
    inside = np.clip(opacity.astype(np.float64), _MIN_OPACITY_MARGIN, 1 - _MIN_OPACITY_MARGIN)
    return np.log(inside / (1 - inside))


def colours_of(harmonics: Floats) -> Floats:
    """Mean colours [N 3] of harmonics [N K 3]."""
    return 0.5 + HARMONIC * harmonics[:, 0].astype(np.float64)


def constants_of(colours: Floats) -> Floats:
    """Harmonics [N 1 3] of mean colours [N 3]."""
    return (colours[:, None].astype(np.float64) - 0.5) / HARMONIC


def unit_quaternions(quaternions: Floats) -> NDArray[np.float64]:
    """Quaternions [N 4] of length 1."""
    turns = quaternions.astype(np.float64)
    return np.asarray(turns / np.linalg.norm(turns, axis=1, keepdims=True))


def smallest_three(quaternions: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Of unit quaternions [N 4], up to their sign: which component is the largest [N], and the others times
    sqrt 2 [N 3].

    The others lie in [-1, 1].
    """
    unit = unit_quaternions(quaternions)
    largest = np.abs(unit).argmax(1)
    rows = np.arange(len(unit))
    # q and -q are one rotation: the component that is left out is made positive.
    unit = unit * np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    return largest, unit[rows[:, None], _OTHER_COMPONENTS[largest]] * 2**0.5


def three_to_four(largest: NDArray[np.int64], three: Floats) -> Floats:
    """The quaternions [N 4] of `smallest_three`."""
    rows = np.arange(len(three))
    others = three / 2**0.5
    out = np.empty((len(three), 4))
    out[rows[:, None], _OTHER_COMPONENTS[largest]] = others
    out[rows, largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(1)))
    return out


def turned_harmonics(rotation: Floats, bands: int) -> Floats:
    """The matrix [K K] that turns harmonics as a rotation [3 3], or a mirroring, turns points.

    It is solved for from values at directions before and after: exact, since each degree is closed under
    rotations.
    """
    there = torch.nn.functional.normalize(
        torch.randn(64, 3, generator=torch.Generator().manual_seed(0)).double(), dim=1
    )
    before = there @ torch.from_numpy(np.asarray(rotation, np.float64))
    degree = round(bands**0.5)
    matrix = torch.linalg.lstsq(
        spherical_harmonics(there, degree), spherical_harmonics(before, degree)
    ).solution
    whole = matrix.round()  # turns by right angles and mirrorings are whole numbers, exactly
    return np.asarray(torch.where((matrix - whole).abs() < _MAX_ROUNDING_OF_TURNS, whole, matrix))


def levels_of(means: Floats) -> NDArray[np.int64]:
    """0 for the bulk of means [N 3], 1 for the bulk of those far from it, and so on."""
    level = np.zeros(len(means), np.int64)
    rest = np.arange(len(means))
    # What is far from the bulk of the rest may have a bulk of its own, and so on.
    while len(rest := rest[bulk_of(means[rest]).apart > _MIN_OUTLIER_DISTANCE]):
        level[rest] += 1
    return level


def spatial_order(means: Floats) -> NDArray[np.int64]:
    """An order in which neighbours in space follow each other (Z-order curve of 1024 cells a side), outliers
    last.
    """
    level = levels_of(means)
    order = []
    for k in range(int(level.max(initial=-1)) + 1):
        at = np.flatnonzero(level == k)
        # A grid of each level: one outlier would leave all others in one cell.
        points = means[at].astype(np.float64)
        low = points.min(0)
        high = points.max(0)
        span = np.maximum(high - low, np.finfo(np.float32).tiny)
        cells = (points - low) / span * (_ORDER_CELLS - 1)
        order.append(at[morton_order(cells.astype(np.int64))])
    return np.concatenate(order) if order else level


def precise(means: Floats, step: Callable[[Floats, Floats], float], share: float) -> Bools:
    """Means [N 3] that a file keeps: all, or all but outliers for which the others would lose precision.

    `step` is the distance between positions that the file tells apart, of the means kept and of their bulk.
    It shall be at most `share` of the extent of the bulk; where the bulk itself does not allow that, what it
    allows.
    """
    bulk = bulk_of(means)
    if bulk.side == 0:
        return np.ones(len(means), bool)
    inner = means[bulk.apart <= 0.5]
    tried = [np.inf, *(2.0**k for k in range(14, -1, -1))]
    wanted = max(share * bulk.side, step(means[bulk.apart <= tried[-1]], inner))
    # The widest reach that is precise enough: the last one is by the definition of `wanted`.
    for reach in tried:
        kept = bulk.apart <= reach
        if step(means[kept], inner) <= wanted:
            break
    return kept
