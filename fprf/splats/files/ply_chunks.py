"""SuperSplat's compressed PLY: Gaussians in chunks of 256, each number some bits between the chunk's bounds.

Element `chunk`: bounds of positions, ln-scales and, mostly, colours; `vertex`: four 32-bit words, position and
scale of 11, 10 and 11 bits, rotation of 2 + 3 x 10, RGBA of 8 each; `sh`: bytes, (v + 0.5) / 256 of [-4, 4].
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ..gaussians import COUNTS, Gaussians
from . import base
from .base import Bools, Capture, Data, Floats
from .ply_tables import Element, Header

CHUNK_GAUSSIANS = 256
"""Gaussians that share their bounds; SuperSplat's."""
_MEAN_COLOUR_RANGE = (-1.5, 2.5)
"""Mean colours that are written: beyond, they are white or black from everywhere, and would spoil those of
their chunk.
"""
_LN_SCALE_RANGE = (-20.0, 20.0)
"""ln-scales that are written, for the same reason; SuperSplat's own limits."""
_MAX_OUTLIERS = 32
"""Outliers that are left out, at most; more are surroundings (by eye)."""
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
"""Properties of `vertex`, a word each."""
_POSITION_BITS = (11, 10, 11)
"""Of positions and of scales."""
_ROTATION_BITS = (10, 10, 10)
"""Of the three smaller components of a rotation; two bits say which one is left out."""
_COLOUR_BITS = (8, 8, 8, 8)
"""Of red, green, blue and opacity."""
_HARMONIC_RANGE = 8.0
"""Width of that of harmonics, [-4, 4]."""


class _Bounds(NamedTuple):
    """Names of the properties of a chunk that bound one of its quantities."""

    low: tuple[str, ...]
    high: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return self.low + self.high


_POSITION_BOUNDS = _Bounds(("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z"))
_SCALE_BOUNDS = _Bounds(
    ("min_scale_x", "min_scale_y", "min_scale_z"), ("max_scale_x", "max_scale_y", "max_scale_z")
)
_COLOUR_BOUNDS = _Bounds(("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b"))
"""Missing in early files."""


def is_chunked(header: Header) -> bool:
    """True for a PLY of this layout."""
    return header.has_property(_WORDS[0])


def read_chunks(path: Path, data: Data, elements: Mapping[str, Element]) -> Capture:
    """The capture of a file of this layout. Raises DataError for others."""
    _check(path, elements)
    chunks = _Chunks(data, elements)

    def recolour(harmonics: Floats, changed: Bools) -> list[bytes]:
        return [bytes(_recoloured(chunks, harmonics, changed))]

    gaussians, shift = base.decoded(1 + len(chunks.rest) // 3, (chunks.count, chunks.decoded))
    return Capture(path, gaussians, False, data, recolour, shift=shift)


def chunk_tables(gaussians: Gaussians) -> dict[str, NDArray[np.void]]:
    """The elements of a file of Gaussians, which are put in spatial order, so that bounds are narrow.

    No chunk holds both the bulk and what is far from it: before the latter transparent Gaussians fill up the
    last one.
    """
    index = _chunk_order(gaussians)
    filled = index[1:] == index[:-1]
    means, turns, scales, logits, harmonics = base.arrays(gaussians.select(torch.from_numpy(index)))
    # Each property as shares of the bounds of its chunk, several in one word.
    words = np.zeros((len(means), len(_WORDS)), np.uint32)
    share, low, high = _in_chunks(means)
    words[:, 0] = base.pack_bits(share, _POSITION_BITS)
    bounds: list[Floats] = [low, high]
    largest, three = base.smallest_three(turns)
    words[:, 1] = largest << 30 | base.pack_bits(three / 2 + 0.5, _ROTATION_BITS)
    share, low, high = _in_chunks(np.clip(scales, *_LN_SCALE_RANGE))
    words[:, 2] = base.pack_bits(share, _POSITION_BITS)
    bounds += [low, high]
    share, low, high = _in_chunks(base.colours_of(harmonics).clip(*_MEAN_COLOUR_RANGE))
    opacity = base.sigmoid(logits)
    opacity[1:][filled] = 0
    words[:, 3] = base.pack_bits(np.concatenate([share, opacity[:, None]], 1), _COLOUR_BITS)
    bounds += [low, high]
    # Three tables: bounds of chunks, words of Gaussians and bytes of harmonics.
    names = [*_POSITION_BOUNDS.names, *_SCALE_BOUNDS.names, *_COLOUR_BOUNDS.names]
    chunk = np.concatenate(bounds, 1).astype("<f4")
    tables = {
        "chunk": chunk.view([(name, "<f4") for name in names])[:, 0],
        "vertex": words.astype("<u4").view([(name, "<u4") for name in _WORDS])[:, 0],
    }
    if harmonics.shape[1] > 1:
        rest = _rest_bytes(harmonics)
        tables["sh"] = rest.view([(f"f_rest_{i}", "u1") for i in range(rest.shape[1])])[:, 0]
    return tables


def kept_by_chunks(gaussians: Gaussians) -> Bools:
    """All but a few outliers, which would need chunks of their own."""
    level = base.levels_of(gaussians.means.numpy())
    beyond = len(level) - np.cumsum(np.bincount(level, minlength=1))
    return level <= int((beyond <= _MAX_OUTLIERS).argmax())


def flat_harmonics(harmonics: Floats) -> Floats:
    """Columns as PLY files have them [N 3 K]: the three constants, then channel by channel."""
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(len(harmonics), 3 * harmonics.shape[1] - 3)
    return np.concatenate([harmonics[:, 0], rest], 1)


class _Chunks:
    """The tables of a file; without an element `sh` there are no harmonics but the constants."""

    def __init__(self, data: Data | bytearray, elements: Mapping[str, Element]) -> None:
        self.data = data
        self.elements = elements
        self.chunk = elements["chunk"].table(data)
        self.vertex = elements["vertex"].table(data)
        self.sh = elements["sh"].table(data) if "sh" in elements else None
        self.rest: tuple[str, ...] = elements["sh"].names() if "sh" in elements else ()
        self.count = len(self.vertex)
        self.of = np.arange(self.count) // CHUNK_GAUSSIANS
        """The chunk of each Gaussian."""
        self.has_colour_bounds = _COLOUR_BOUNDS.low[0] in elements["chunk"].names()

    def decoded(self, rows: slice) -> tuple[Floats, ...]:
        """Some of the Gaussians as `base.decoded` wants them."""
        position, turned, scale, colour = (self.vertex[name][rows] for name in _WORDS)
        rgba = base.unpack_bits(colour, _COLOUR_BITS)
        rgb = rgba[:, :3]
        if self.has_colour_bounds:
            rgb = self._within(rgb, rows, _COLOUR_BOUNDS)
        harmonics = base.constants_of(rgb)
        if self.sh is not None:
            # The two outermost bytes stand for the very ends of the range.
            parts = []
            for name in self.rest:
                parts.append(self.sh[name][rows])
            raw = np.stack(parts, 1)
            share = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
            bands = ((share - 0.5) * _HARMONIC_RANGE).reshape(len(raw), 3, -1).transpose(0, 2, 1)
            harmonics = np.concatenate([harmonics, bands], 1)
        largest = (turned >> 30).astype(np.int64)
        return (
            self._within(base.unpack_bits(position, _POSITION_BITS), rows, _POSITION_BOUNDS),
            base.three_to_four(largest, 2 * base.unpack_bits(turned, _ROTATION_BITS) - 1),
            self._within(base.unpack_bits(scale, _POSITION_BITS), rows, _SCALE_BOUNDS),
            base.logit(rgba[:, 3]),
            harmonics,
        )

    def _within(self, share: Floats, rows: slice, bounds: _Bounds) -> Floats:
        """Shares [n 3] of some rows as numbers between the bounds of their chunks."""
        of = self.of[rows]
        parts = []
        for name in bounds.low:
            parts.append(self.chunk[name][of])
        low = np.stack(parts, 1).astype(np.float64)
        parts = []
        for name in bounds.high:
            parts.append(self.chunk[name][of])
        high = np.stack(parts, 1).astype(np.float64)
        return np.asarray(low * (1 - share) + high * share)


def _check(path: Path, elements: Mapping[str, Element]) -> None:
    """Raise DataError where a property that SuperSplat writes is missing or of another type; only bounds of
    colours are missing in early files.
    """
    known = {name: element.names() for name, element in elements.items()}
    bounds = [*_POSITION_BOUNDS.names, *_SCALE_BOUNDS.names]
    if _COLOUR_BOUNDS.low[0] in known.get("chunk", ()):
        bounds += _COLOUR_BOUNDS.names
    for element, names, kind in (("chunk", bounds, "<f4"), ("vertex", _WORDS, "<u4")):
        for name in names:
            if name not in known.get(element, ()) or elements[element].kind[name] != kind:
                raise DataError(f"{path}: no property {name}; not the compressed layout of SuperSplat")
    # Harmonics, where there are any, are one row of bytes a Gaussian.
    count = elements["vertex"].rows
    if "sh" in elements:
        sh = elements["sh"]
        rest = sh.names()
        named = [*rest] == [f"f_rest_{i}" for i in range(len(rest))]
        whole = len(rest) % 3 == 0 and 1 + len(rest) // 3 in COUNTS
        bytes_alone = all(sh.kind[name] == "u1" for name in rest)
        if not (named and whole and bytes_alone) or sh.rows != count:
            raise DataError(
                f"{path}: element `sh` with {len(rest)} properties and {sh.rows} rows; not SuperSplat's layout"
            )
    chunks = elements["chunk"].rows
    if chunks != -(-count // CHUNK_GAUSSIANS):
        raise DataError(
            f"{path}: {chunks} chunks for {count} Gaussians; there is one for each {CHUNK_GAUSSIANS}"
        )


def _recoloured(chunks: _Chunks, harmonics: Floats, changed: Bools) -> bytearray:
    """The file with other colours of some Gaussians."""
    out = bytearray(chunks.data)
    target = _Chunks(out, chunks.elements)
    share = base.colours_of(base.finite(harmonics))
    rounded = changed
    if chunks.has_colour_bounds:
        # A chunk in which anything changes gets new bounds, and all of its colours are rounded again.
        share, low, high = _in_chunks(share.clip(*_MEAN_COLOUR_RANGE))
        there = np.unique(chunks.of[changed])
        rounded = np.isin(chunks.of, there)
        for names, values in ((_COLOUR_BOUNDS.low, low), (_COLOUR_BOUNDS.high, high)):
            for name, column in zip(names, values.T, strict=True):
                target.chunk[name][there] = column[there]
    opacity = chunks.vertex["packed_color"] & 255
    colour = base.pack_bits(share, _COLOUR_BITS[:3]).astype(np.uint32) << 8 | opacity
    target.vertex["packed_color"][rounded] = colour[rounded]
    if target.sh is not None:
        for name, column in zip(chunks.rest, _rest_bytes(harmonics).T, strict=True):
            target.sh[name][changed] = column[changed]
    return out


def _chunk_order(gaussians: Gaussians) -> NDArray[np.int64]:
    """Indices of Gaussians in spatial order; of each level but the last its last one fills up its chunk."""
    means = gaussians.means.numpy()
    order = base.spatial_order(means)
    level = base.levels_of(means)
    parts = []
    last = int(level.max(initial=0))
    for k in range(last + 1):
        part = order[level[order] == k]
        if k < last:
            part = np.append(part, np.full(-len(part) % CHUNK_GAUSSIANS, part[-1]))
        parts.append(part)
    return np.concatenate(parts)


def _rest_bytes(harmonics: Floats) -> NDArray[np.uint8]:
    """All but the constants as these files have them."""
    rest = flat_harmonics(harmonics)[:, 3:]
    return np.asarray(np.clip(np.floor((base.finite(rest) / _HARMONIC_RANGE + 0.5) * 256), 0, 255), np.uint8)


def _in_chunks(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Values [N C] as shares of the bounds of their chunks, and these bounds [chunks C]."""
    starts = np.arange(0, len(values), CHUNK_GAUSSIANS)
    low = np.minimum.reduceat(values, starts, axis=0).astype(np.float32)
    high = np.maximum.reduceat(values, starts, axis=0).astype(np.float32)
    at = np.arange(len(values)) // CHUNK_GAUSSIANS
    return base.shares(values, low[at], high[at]), low, high
