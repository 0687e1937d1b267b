"""Files of 3D Gaussians, read, recoloured and written in the formats that are installed
(`base.CaptureFormat`).
"""

import mmap
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...errors import DataError
from ...rendering.cameras import Cameras
from ...rendering.local_frame import added_and_beside, read_offset, write_offset
from ...rendering.north import Bearings
from ...types import Origin
from ..activation import activated as with_activated
from ..activation import file_harmonics, find_activation
from ..drawing import seen_means
from ..gaussians import GaussianRows, Gaussians, bulk_of
from .base import Bools, Capture, CaptureFormat, Data, Floats, format_of, pieces, release

__all__ = ["Capture", "Written", "read_capture", "release", "write_capture", "write_gaussians"]

_MIN_MAPPED_BYTES = 1 << 28
"""Of files that are mapped: smaller ones are read faster than they are mapped, and fit beside the rest."""
_LFS_POINTER = b"version https://git-lfs"
"""Begin of the text that Git leaves in the place of a large file."""
_MAX_STEP_OF_FLOATS = 0.05
"""Of positions, in extents of the bulk: beyond, its shape is lost (by eye)."""


class Written(NamedTuple):
    """Losses of a file that was written."""

    faulty: bool = False
    """The Gaussians that cannot be drawn (`Gaussians.faults`) are left out."""
    far: int = 0
    """Outliers that are left out: so far from the others that the format's numbers do not reach both."""
    notes: tuple[str, ...] = ()
    """Limits, each as a phrase."""

    def losses(self) -> list[str]:
        """Losses but for Gaussians that cannot be drawn, and limits, each as a phrase."""
        if self.far:
            return [f"{self.far} far from the others left out", *self.notes]
        return list(self.notes)


def read_capture(path: Path, *, activated: bool = False) -> Capture:
    """Read a file of Gaussians, or a folder of SOG. Raises DataError for another ending, or a file that is
    not what it says.

    `activated`: opacities, sizes and colours that look activated already (`splats.activation`) are taken so.
    """
    if path.is_dir():
        index = path / "lod-meta.json"
        path = index if index.is_file() else path / "meta.json"
    form = format_of(path)
    data = _content(path)
    if data[: len(_LFS_POINTER)] == _LFS_POINTER:
        raise DataError(f"{path}: a pointer of Git LFS in the place of the file; run git lfs pull")
    with np.errstate(over="ignore", invalid="ignore"):  # damaged files hold numbers of any kind
        capture = form.read(path, data)
    release(data)
    if not len(capture.gaussians):
        raise DataError(f"{path}: holds no Gaussian")
    capture = _with_activation(capture, activated)
    finite = capture.gaussians.finite
    if not bool(finite.any()):
        reasons = " and ".join(capture.gaussians.faults())
        remedy = "; ".join([*capture.notes, "export the capture again"])
        raise DataError(f"{path}: holds no Gaussian that can be drawn, but {reasons}; {remedy}")
    _check_precision(capture, capture.gaussians.means[finite].numpy())
    x, y, z = capture.shift
    camera = None
    if capture.camera is not None:
        camera = capture.camera.shifted((-x, -y, -z))
    return replace(capture, camera=camera, offset=read_offset(path))


def _content(path: Path) -> Data:
    """The bytes of a file; large ones are mapped: what was decoded need not stay in memory beside the
    Gaussians.
    """
    try:
        if path.stat().st_size < _MIN_MAPPED_BYTES:
            return path.read_bytes()
        with path.open("rb") as file:
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from error


def _with_activation(capture: Capture, asked: bool) -> Capture:
    """A capture with what was found out about its numbers being activated: a note, and where that was asked
    for the Gaussians that it means.
    """
    found = find_activation(capture.gaussians, asked=asked)
    if not asked and not found:
        return capture
    if not asked:
        note = f"its {found}, as if activated already; if so, read it with --activated true"
        return replace(capture, notes=(*capture.notes, note), activation=found)
    if not found:
        note = "none of its opacities, sizes and colours can be activated already; they are read as they are"
        return replace(capture, notes=(*capture.notes, note))

    def recolour(harmonics: Floats, changed: Bools) -> Iterable[bytes]:
        return capture.recolour(file_harmonics(torch.from_numpy(harmonics), found).numpy(), changed)

    note = f"its {found}: read as activated already"
    return replace(
        capture,
        gaussians=with_activated(capture.gaussians, found),
        recolour=recolour,
        notes=(*capture.notes, note),
    )


def _check_precision(capture: Capture, local: Floats) -> None:
    """Raise DataError where float32 rounded a capture far from 0, with local means [N 3], to a few places
    along an axis; positions that were float64 have further digits.
    """
    for axis, away in zip(local.T, np.abs(capture.shift), strict=True):
        step = float(np.spacing(np.float32(away)))
        fine = step <= _MAX_STEP_OF_FLOATS * bulk_of(local).side
        if not away or fine or bool((axis == axis[0]).all()):
            continue
        if not (axis % np.float32(step)).any():
            raise DataError(
                f"{capture.path}: lies {away:.2g} from 0, where float32 has steps of {step:.2g}, too coarse "
                "for its shape; export it closer to the origin, or with float64 positions"
            )


def write_gaussians(
    path: Path,
    gaussians: Gaussians | GaussianRows,
    *,
    antialiased: bool = False,
    views: Cameras | None = None,
    plain: bool = False,
    origin: Origin = (0.0, 0.0, 0.0),
    local: bool = False,
) -> Written:
    """Write a file in the format that its name ends with, whole or not at all. Raises DataError for another
    ending.

    .ply is exact; the others lose what their bits cannot hold, Gaussians that cannot be drawn, and outliers
    that would cost the others their precision; .compressed.ply and SOG have an order of their own. .splat
    holds neither view dependence nor whether opacities are compensated (`antialiased`): it gets the means of
    what `views` show, or the colours over all directions where none are given. With `plain` all formats get
    such opacities, for renderers that do not compensate. Where the Gaussians' `origin` is not 0, .ply holds
    float64 positions in the world; the others, and .ply where `local`, hold those relative to the origin,
    with a file beside them that says so. Of rows that are written as .ply, not `plain`, some at a time are in
    memory; they say themselves whether they are `antialiased`, and where north is, which the file then says, too.
    """
    form = format_of(path)
    bearings = None
    added, beside = added_and_beside(origin, local or not form.exact)
    if isinstance(gaussians, GaussianRows):
        bearings = gaussians.bearings
        if form.exact and form.view_dependent and not plain:
            form.write(path, _told(form, form.pack_rows(gaussians, added), bearings))
            write_offset(path, beside)
            return Written()
        antialiased = gaussians.antialiased
        gaussians = gaussians.part(slice(0, gaussians.count))
    held = _held(path, form, gaussians)
    gaussians = held.gaussians
    # Renderers that know less are given what views show of colours and opacities.
    bare = not form.view_dependent
    asks_views = (bare and gaussians.degree > 0) or (antialiased and (bare or plain))
    if views is not None and len(views) and asks_views:
        seen = seen_means(gaussians, views, antialiased=antialiased)
        if bare:
            gaussians = seen.gaussians(gaussians)
        else:
            gaussians = seen.plain(gaussians)
        antialiased = False
    # The offset comes last, so that a file that cannot be written leaves the one before it in its place.
    form.write(path, _told(form, form.pack(gaussians, antialiased, added), bearings))
    write_offset(path, beside)
    return Written(held.faulty, held.far, tuple(form.notes(gaussians)))


def _told(form: CaptureFormat, pieces: Iterable[bytes], bearings: Bearings | None) -> Iterable[bytes]:
    """A file that also says where north is, where that is known."""
    return pieces if bearings is None else form.with_bearings(pieces, bearings)


class _Held(NamedTuple):
    """Properties of Gaussians that a format holds."""

    gaussians: Gaussians
    faulty: bool
    """Some cannot be drawn, and are left out."""
    far: int
    """Outliers that are left out."""


def _held(path: Path, form: CaptureFormat, gaussians: Gaussians) -> _Held:
    """The Gaussians that a format holds: the others are left out first, so that they decide nothing about the
    rest. Raises DataError where none is left.
    """
    if form.exact:
        return _Held(gaussians, False, 0)
    finite = gaussians.finite
    faulty = not bool(finite.all())
    if faulty:
        gaussians = gaussians.select(finite)
    kept = form.keeps(gaussians)
    if kept is None or bool(kept.all()):
        return _Held(gaussians, faulty, 0)
    if not kept.any():
        raise DataError(f"{path}: all Gaussians lie too far from the origin for this format; write a .ply")
    return _Held(gaussians.select(torch.from_numpy(kept)), faulty, int((~kept).sum()))


def write_capture(
    path: Path, capture: Capture, harmonics: Annotated[Tensor, "N K 3"], views: Cameras | None = None
) -> Written:
    """Write a capture with new harmonics of all its Gaussians, or of all that can be drawn, in the format
    that the name says.

    In the format that it was read from everything else stays as it was, bit for bit; where no harmonic
    differs from those read, that is the whole file. Another format gets what `write_gaussians` gives it, and
    no Gaussians that cannot be drawn.
    """
    finite = capture.gaussians.finite
    before = capture.gaussians.harmonics
    form = format_of(path)
    if len(harmonics) < len(finite):
        harmonics = before.index_copy(0, finite.nonzero()[:, 0], harmonics)
    if not form.holds(capture, format_of(capture.path)):
        drawn = capture.gaussians.recoloured(harmonics).select(finite)
        bearings = None
        if capture.north is not None:
            bearings = Bearings(capture.north.direction, capture.up)
        rows = GaussianRows(len(drawn), drawn.select, capture.antialiased, bearings)
        written = write_gaussians(path, rows, views=views, origin=capture.origin)
        return written._replace(faulty=not bool(finite.all()))
    changed = _changed(before, harmonics)
    if bool(changed.any()):
        form.write(path, capture.recolour(harmonics.numpy(), np.asarray(changed)))
    else:
        form.write(path, _in_pieces(capture.data))
    write_offset(path, capture.offset)
    return Written()


def _changed(before: Annotated[Tensor, "N K 3"], after: Annotated[Tensor, "N K 3"]) -> Annotated[Tensor, "N"]:
    """Gaussians with other harmonics that are finite; some rows at a time, to save memory."""
    found = []
    for rows in pieces(len(before)):
        other = (after[rows] != before[rows]).flatten(1).any(1)
        found.append(other & after[rows].isfinite().flatten(1).all(1))
    return torch.cat(found)


def _in_pieces(data: Data) -> Iterator[bytes]:
    """A file as it is."""
    for start in range(0, len(data), _MIN_MAPPED_BYTES):
        yield data[start : start + _MIN_MAPPED_BYTES]
