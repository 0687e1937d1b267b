"""Levels of detail: chunks of Gaussians that are near to each other, each also as fewer and larger ones.

A chunk is a box of a k-d tree. Its level k has a Gaussian for each 4^k along a Morton curve, with the mean,
the covariance and the colour of their mixture by weight (opacity times area), and as much opacity times area
as they have together (compare Kerbl et al. 2024, a hierarchical 3D Gaussian representation). A view takes of
each chunk in its frustum the coarsest level in which what was merged lies within a given number of pixels;
the others cost it nothing.
"""

import io
import math
import mmap
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..io.atomic import atomic_path
from ..ops.rasterise.rendering import Pinhole
from ..rendering.splines import quaternions, rotations
from .gaussians import Gaussians, from_rows
from .initial import curve_order

_CHUNK_GAUSSIANS = 512
"""Gaussians of a chunk; by eye."""
_MERGED_GAUSSIANS = 4
"""Gaussians that are merged into one of the next level; by eye."""
_LEVEL_COUNT = 4
"""Levels, the finest included; by eye."""
_REACH_DEVIATIONS = 3.0
"""Reach of a Gaussian, in standard deviations: 98.9 % of its weight."""
_MAX_REACH_DEVIATIONS = 3.5
"""Reach in standard deviations where nothing may be left out: at least sqrt(-2 log MIN_ALPHA) = 3.33
(`ops.rasterise`).
"""
_WIDENED_PIXELS = 2.0
"""Pixels that drawing widens that reach by."""
_MAX_MERGED_OPACITY = 0.995
"""Largest opacity of what is merged: beyond it there is no logit worth having; by eye."""
_STRAY_SHARE = 0.02
"""Share of the means at either end that does not say how long a chunk is; by eye."""
_WIDTH_QUANTILE = 0.9
"""Quantile that says how wide a chunk is, and how far apart is what a level merges; by eye."""
_RECOLOURED_CHUNKS = 64
"""Chunks that are recoloured together; by eye: bounds the memory."""
_WRITTEN_GAUSSIANS = 1 << 17
"""Gaussians that are in memory at a time while levels are written."""
_MAX_COLOUR_BYTES = 1 << 28
"""Bytes of colours that a look keeps of chunks it has drawn; by eye."""

# File of a run's levels: rows, their order (int32), an .npz archive of the tables, the bytes of that archive as
# a number; all little endian.

_LEVELS_FILE = "rows.bin"
_LEVELS_VERSION = 2
"""Version of that file: another one is written anew."""
_TABLE_NAMES = ("begin", "spread", "centre", "radius", "core")
_NUMBER_BYTES = 8
"""Bytes of the number at its end."""


@dataclass(frozen=True, eq=False)
class Levels:
    """B chunks in L levels, the rows of a chunk and level side by side in memory."""

    rows: Annotated[NDArray[np.float32], "N R"]
    """Gaussians as `Gaussians.rows`."""
    begin: Annotated[NDArray[np.int64], "B L+1"]
    """First row of each level of a chunk; then the end of the last one."""
    spread: Annotated[NDArray[np.float64], "B L"]
    """Distances over which a level merges, in world units; 0 in the finest."""
    centre: Annotated[NDArray[np.float64], "B 3"]
    radius: Annotated[NDArray[np.float64], "B"]
    """Radius of a ball around all that a chunk shows."""
    core: Annotated[NDArray[np.float64], "B"]
    """Radius of a ball around nearly all means of a chunk."""
    order: Annotated[NDArray[np.int32], "N"]
    """Number of the Gaussian in each row of the finest level, chunk after chunk."""
    mapped: mmap.mmap | None = None
    """The file that the rows lie in: of its pages none stays in memory."""

    def select(self, camera: Pinhole, pixels: float) -> Gaussians:
        """Return the Gaussians that a camera sees, merged where they lie within `pixels`; 0 = nothing is
        merged.
        """
        return self.gather(*self.visible(camera, pixels))

    def visible(self, camera: Pinhole, pixels: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the chunks that a camera sees, in ascending order, and the level of each."""
        local, seen = in_view(camera, self.centre, self.radius)
        fx = float(camera.intrinsics[0, 0])
        fy = float(camera.intrinsics[1, 1])
        distance = np.maximum(np.linalg.norm(local, axis=1) - self.core, camera.near)
        fine = self.spread * max(fx, fy) <= pixels * distance[:, None]
        level = np.minimum.accumulate(fine, axis=1).sum(1) - 1
        chunks = np.flatnonzero(seen)
        return chunks, level[chunks]

    def gather(self, chunks: NDArray[np.int64], level: NDArray[np.int64]) -> Gaussians:
        """Return the Gaussians of chunks, each at its level."""
        first = self.begin[chunks, level]
        last = self.begin[chunks, level + 1]
        parts = [self.rows[a:b] for a, b in zip(first, last, strict=True)] or [self.rows[:0]]
        nodes = np.concatenate(parts)
        if self.mapped is not None and hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
            self.mapped.madvise(mmap.MADV_DONTNEED)
        return from_rows(torch.from_numpy(nodes))


class StyledLevels:
    """Levels in other colours: those of a chunk are made when it is first drawn, and kept while there is
    room.

    What is merged has the mean of the new colours of its Gaussians, as if the levels had been made of these.
    """

    def __init__(
        self,
        levels: Levels,
        recolour: Callable[[Gaussians, Annotated[Tensor, "M"]], Annotated[Tensor, "M K 3"]],
    ) -> None:
        """`recolour` gives harmonics for Gaussians and their numbers in the scene."""
        self._levels = levels
        self._recolour = recolour
        self._colours: OrderedDict[tuple[int, int], Tensor] = OrderedDict()
        self._bytes = 0

    def select(self, camera: Pinhole, pixels: float) -> Gaussians:
        """Return what `Levels.select` would, recoloured."""
        chunks, level = self._levels.visible(camera, pixels)
        shown = self._levels.gather(chunks, level)
        # Recolour what was never drawn, level by level, some chunks together.
        keys = list(zip(chunks.tolist(), level.tolist(), strict=True))
        rows = []
        for key in keys:
            rows.append(key not in self._colours)
        new = np.array(rows, bool)
        for k in np.unique(level[new]):
            here = chunks[new & (level == k)]
            for first in range(0, len(here), _RECOLOURED_CHUNKS):
                self._add(here[first : first + _RECOLOURED_CHUNKS], int(k))
        # What was drawn last stays longest.
        parts = []
        for key in keys:
            parts.append(self._colours[key])
        for key in keys:
            self._colours.move_to_end(key)
        while self._bytes > _MAX_COLOUR_BYTES:
            self._bytes -= self._colours.popitem(last=False)[1].nbytes
        if parts:
            return shown.recoloured(torch.cat(parts))
        return shown

    def _add(self, chunks: NDArray[np.int64], level: int) -> None:
        """Recolour the Gaussians of chunks and merge them up to a level."""
        # New colours of the finest level; each coarser one has the means of the level before, by the weights
        # of its Gaussians.
        levels = self._levels
        gaussians = levels.gather(chunks, np.zeros_like(chunks))
        parts = []
        for chunk in chunks:
            parts.append(levels.order[_CHUNK_GAUSSIANS * chunk : _CHUNK_GAUSSIANS * (chunk + 1)])
        index = np.concatenate(parts).astype(np.int64)
        harmonics = self._recolour(gaussians, torch.from_numpy(index))
        for k in range(level):
            if k:
                gaussians = levels.gather(chunks, np.full_like(chunks, k))
            harmonics = _merged_harmonics(harmonics, *_shares(gaussians)[:2]).float()
        sizes = levels.begin[chunks, level + 1] - levels.begin[chunks, level]
        for chunk, colours in zip(chunks.tolist(), torch.split(harmonics, sizes.tolist()), strict=True):
            self._colours[chunk, level] = colours.clone()
            self._bytes += colours.nbytes


def in_view(
    camera: Pinhole,
    centre: Annotated[NDArray[np.float64], "B 3"],
    radius: Annotated[NDArray[np.float64], "B"],
) -> tuple[Annotated[NDArray[np.float64], "B 3"], Annotated[NDArray[np.bool_], "B"]]:
    """Centres of balls as the camera sees them, and whether it may see a part of each."""
    pose = camera.world_to_camera.double().numpy()
    fx, fy, cx, cy = (float(camera.intrinsics[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    local = centre @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = local.T
    seen = z + radius > camera.near
    # Distance from the planes through the camera and the image's sides; normals point outwards.
    for along, slope in (
        (-x, cx / fx),
        (x, (camera.width - cx) / fx),
        (-y, cy / fy),
        (y, (camera.height - cy) / fy),
    ):
        seen &= (along - slope * z) / math.hypot(1, slope) < radius
    return local, seen


def seen_by(gaussians: Gaussians, camera: Pinhole) -> Annotated[Tensor, "M"]:
    """Numbers of the Gaussians that a camera may see."""
    means = gaussians.means.double().numpy()
    pose = camera.world_to_camera.double()
    away = np.linalg.norm(means + (pose[:3, :3].T @ pose[:3, 3]).numpy(), axis=1)
    widened = _WIDENED_PIXELS / float(min(camera.intrinsics[0, 0], camera.intrinsics[1, 1])) * away
    _, seen = in_view(
        camera, means, _MAX_REACH_DEVIATIONS * gaussians.log_scales.double().amax(1).exp().numpy() + widened
    )
    return torch.from_numpy(np.flatnonzero(seen))


def make_levels_of_detail(gaussians: Gaussians) -> Levels:
    """Sort Gaussians into chunks and merge them; all must be finite."""
    # Gaussians chunk after chunk, then level after level, each with how far apart lies what it merges.
    position = gaussians.means.double().numpy()
    order = torch.from_numpy(np.concatenate(_chunks(position, np.arange(len(position)))))
    levels = [gaussians.select(order)]
    sizes = [np.full(len(order), 0.0)]
    for _ in range(_LEVEL_COUNT - 1):
        merged, apart = _merged(levels[-1])
        before = sizes[-1]
        # What lies apart in a level was apart already in the one before.
        fill = np.pad(before, (0, -len(before) % _MERGED_GAUSSIANS)).reshape(-1, _MERGED_GAUSSIANS).max(1)
        levels.append(merged)
        sizes.append(np.hypot(apart, fill))
    # Of each chunk the rows of its levels, one after the other, and the balls around what it shows and around
    # its means.
    count = -(-len(order) // _CHUNK_GAUSSIANS)
    width = []
    for k in range(_LEVEL_COUNT):
        width.append(_CHUNK_GAUSSIANS // _MERGED_GAUSSIANS**k)
    tables = []
    for level in levels:
        tables.append(level.rows.numpy())
    parts = []
    begin = np.zeros((count, _LEVEL_COUNT + 1), np.int64)
    spread = np.zeros((count, _LEVEL_COUNT))
    centre = np.zeros((count, 3))
    radius = np.zeros(count)
    core = np.zeros(count)
    at = 0
    reach = _REACH_DEVIATIONS * np.exp(levels[0].log_scales.double().amax(1).numpy())
    means = levels[0].means.double().numpy()
    for chunk in range(count):
        for k, (table, each) in enumerate(zip(tables, width, strict=True)):
            part = slice(chunk * each, (chunk + 1) * each)
            begin[chunk, k] = at
            parts.append(table[part])
            at += len(table[part])
            spread[chunk, k] = np.quantile(sizes[k][part], _WIDTH_QUANTILE)
        begin[chunk, -1] = at
        own = slice(chunk * _CHUNK_GAUSSIANS, (chunk + 1) * _CHUNK_GAUSSIANS)
        centre[chunk] = np.median(means[own], axis=0)
        away = np.linalg.norm(means[own] - centre[chunk], axis=1)
        radius[chunk] = (away + reach[own]).max()
        core[chunk] = np.quantile(away, _WIDTH_QUANTILE)
    return Levels(np.concatenate(parts), begin, spread, centre, radius, core, order.numpy().astype(np.int32))


def write_levels(folder: Path, gaussians: Gaussians, key: str) -> None:
    """Write levels of detail that `open_levels` maps, in bounded memory where the Gaussians are mapped from a
    file themselves.

    Neighbours in memory should be neighbours in space, as the cells of a union are. All lies in one file,
    which is replaced as a whole. Raises DataError where the system refuses.
    """
    columns: list[tuple[NDArray[Any], ...]] = []
    orders: list[NDArray[np.int32]] = []
    written = 0
    with atomic_path(folder / _LEVELS_FILE) as temporary, temporary.open("wb") as file:
        for first in range(0, len(gaussians), _WRITTEN_GAUSSIANS):
            levels = make_levels_of_detail(
                gaussians.select(torch.arange(first, min(first + _WRITTEN_GAUSSIANS, len(gaussians))))
            )
            file.write(levels.rows.tobytes())
            columns.append((levels.begin + written, levels.spread, levels.centre, levels.radius, levels.core))
            orders.append(levels.order + np.int32(first))
            written += len(levels.rows)
        for order in orders:
            file.write(order.tobytes())
        parts = {}
        for name, column in zip(_TABLE_NAMES, zip(*columns, strict=True), strict=True):
            parts[name] = np.concatenate(column)
        tables = io.BytesIO()
        width = np.array(levels.rows.shape[1])
        count = np.array(len(gaussians))
        np.savez(
            tables,
            allow_pickle=False,
            key=np.array(f"{_LEVELS_VERSION} {key}"),
            width=width,
            count=count,
            **parts,
        )
        file.write(tables.getvalue() + len(tables.getvalue()).to_bytes(_NUMBER_BYTES, "little"))


def open_levels(folder: Path, key: str) -> Levels | None:
    """Levels mapped from a file; None where there are none of this key."""
    try:
        with (folder / _LEVELS_FILE).open("rb") as file:
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        # From the end: the length of the archive, the archive, and what lies before it.
        end = len(mapped) - _NUMBER_BYTES
        begin = end - int.from_bytes(mapped[end:], "little")
        if begin < 0:
            return None
        with np.load(io.BytesIO(mapped[begin:end])) as tables:
            if str(tables["key"]) != f"{_LEVELS_VERSION} {key}":
                return None
            parts = {}
            for name in _TABLE_NAMES:
                parts[name] = tables[name]
            count = int(tables["count"])
            rows = np.frombuffer(mapped, np.float32, begin // 4 - count).reshape(-1, int(tables["width"]))
            order = np.frombuffer(mapped, np.int32, count, begin - 4 * count)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return Levels(rows=rows, **parts, order=order, mapped=mapped)


def _chunks(
    position: Annotated[NDArray[np.float64], "N 3"], index: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Indices in chunks, all but the last one full: halved across the longest side, then along a Morton
    curve.
    """
    if len(index) <= _CHUNK_GAUSSIANS:
        if len(index):
            return [index[curve_order(position[index])]]
        return []
    own = position[index]
    axis = int((np.quantile(own, 1 - _STRAY_SHARE, axis=0) - np.quantile(own, _STRAY_SHARE, axis=0)).argmax())
    half = max(1, len(index) // (2 * _CHUNK_GAUSSIANS)) * _CHUNK_GAUSSIANS
    order = np.argpartition(own[:, axis], half)
    return _chunks(position, index[order[:half]]) + _chunks(position, index[order[half:]])


def _shares(
    gaussians: Gaussians,
) -> tuple[Annotated[Tensor, "M*4"], Annotated[Tensor, "M 4 1"], Annotated[Tensor, "M 4 1"]]:
    """Numbers of the Gaussians that are merged, `_MERGED_GAUSSIANS` after each other, their shares of what
    they become, and their weights.
    """
    missing = -len(gaussians) % _MERGED_GAUSSIANS
    index = torch.arange(len(gaussians) + missing).clamp_max(len(gaussians) - 1)
    areas = gaussians.log_scales.double().exp().topk(2, dim=1).values.prod(1)
    weight = (gaussians.opacities.double() * areas)[index].clamp_min(1e-30)
    if missing:
        weight[-missing:] = 0
    weight = weight.view(-1, _MERGED_GAUSSIANS, 1)
    return index, weight / weight.sum(1, keepdim=True), weight


def _merged_harmonics(
    harmonics: Annotated[Tensor, "N K 3"], index: Annotated[Tensor, "M*4"], share: Annotated[Tensor, "M 4 1"]
) -> Annotated[Tensor, "M K 3"]:
    return (share[..., None] * harmonics.double()[index].view(len(share), _MERGED_GAUSSIANS, -1, 3)).sum(1)


def _merged(gaussians: Gaussians) -> tuple[Gaussians, NDArray[np.float64]]:
    """Each `_MERGED_GAUSSIANS` neighbours as one, and the standard deviation of their means along its longest axis."""
    # Mean and covariance of a mixture: the mean of the covariances, and the covariance of the means.
    index, share, weight = _shares(gaussians)
    scales = gaussians.log_scales.double().exp()
    means = gaussians.means.double()[index].view(-1, _MERGED_GAUSSIANS, 3)
    mean = (share * means).sum(1)
    axes = rotations(gaussians.quaternions.double()) * scales[:, None]
    covariance = (axes @ axes.mT)[index].view(-1, _MERGED_GAUSSIANS, 3, 3)
    away = means - mean[:, None]
    between = (share[..., None] * away[..., :, None] * away[..., None, :]).sum(1)
    # Its axes are a rotation, not a reflection; opacity times area is that of all of them together.
    values, vectors = torch.linalg.eigh((share[..., None] * covariance).sum(1) + between)
    vectors = vectors * torch.linalg.det(vectors).sign()[:, None, None]
    values = values.clamp_min(1e-20)
    area = values[:, 1:].prod(1).sqrt()
    opacity = (weight.sum((1, 2)) / area).clamp(1e-6, _MAX_MERGED_OPACITY)
    harmonics = _merged_harmonics(gaussians.harmonics, index, share)
    parts = (mean, quaternions(vectors), 0.5 * values.log(), torch.logit(opacity), harmonics)
    apart = torch.linalg.eigvalsh(between)[:, -1].clamp_min(0).sqrt()
    return Gaussians(*(part.float() for part in parts)), apart.numpy()
