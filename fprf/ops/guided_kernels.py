"""Features at pixels from half-precision coefficients: `guided.apply`, compiled by numba on first use and cached.

Layout: one row a stored cell, four runs of P channels (A for red, green and blue, then b), as the bits of float16. P is C
rounded up to whole vectors of NARROW.
4096 pixels x 48 channels take 0.6 ms of one core where the coefficients are in its cache, 2.5 ms over 43 views that are not.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg"

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numba
import numpy as np

from .simd import NARROW, load, load_halves, narrow, store, traced

PIXELS = 64
"""Pixels of a task."""

Floats: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.float32]]


class ViewArrays(NamedTuple):
    """One view as the kernel takes it: F = scale (A I + b) + centre."""

    bits: np.ndarray[tuple[int, ...], np.dtype[np.uint16]]
    """[rows * columns, 4 P], contiguous."""
    rows: int
    columns: int
    height: int
    width: int
    scale: Floats
    centre: Floats


class ViewTable:
    """Views side by side: where each one's coefficients lie, and what else is known of it."""

    def __init__(self, views: Sequence[ViewArrays]) -> None:
        self._kept = [view.bits for view in views]  # the addresses below must stay good
        self.address = np.array([bits.ctypes.data for bits in self._kept], dtype=np.int64)
        self.shape = np.array([(v.rows, v.columns, v.height, v.width) for v in views], dtype=np.int64)
        self.scale = np.stack([view.scale for view in views]).astype(np.float32)
        self.centre = np.stack([view.centre for view in views]).astype(np.float32)
        self.run = self._kept[0].shape[1] // 4


@traced
def _add_halves(total, at, address, weight):
    """total[at : at + NARROW] += weight * 2^-112 * the float16 numbers whose bits lie at an address."""
    store(total, at, load(total, at, NARROW) + load_halves(address, NARROW) * narrow(weight, NARROW))


@numba.njit(inline="always", cache=True)
def _corner(position, cells):
    """Lower cell, upper cell, share of the upper one; NaN falls on the lower border: no index may leave the table."""
    at = position - np.float32(0.5)
    at = min(at, np.float32(cells - 1)) if at > np.float32(0) else np.float32(0)
    low = int(at)
    return low, min(low + 1, cells - 1), at - np.float32(low)


def gather_views(table: ViewTable, slot: np.ndarray, pixel: Floats, rgb: Floats, out: Floats) -> None:
    """out[i] = F at pixel[i] [R 2] with colour rgb[i] [R 3] of the table's view slot[i]."""
    _gather(slot, table.address, table.shape, table.scale, table.centre, table.run, pixel, rgb, out)


@numba.njit(parallel=True, cache=True, nogil=True, fastmath={"contract"})
def _gather(slot, address, shape, scale, centre, run, pixel, rgb, out):
    channels = scale.shape[1]
    exponent = np.float32(2.0**112)
    for task in numba.prange((len(slot) + PIXELS - 1) // PIXELS):
        total = np.empty(run, dtype=np.float32)
        for i in range(task * PIXELS, min(len(slot), task * PIXELS + PIXELS)):
            view = slot[i]
            rows, columns = shape[view, 0], shape[view, 1]
            vertical, horizontal = np.float32(rows / shape[view, 2]), np.float32(columns / shape[view, 3])
            top, bottom, v = _corner(pixel[i, 1] * vertical, rows)
            left, right, u = _corner(pixel[i, 0] * horizontal, columns)
            total[:] = np.float32(0)
            for corner in range(4):
                y, x = (bottom if corner & 2 else top), (right if corner & 1 else left)
                share = (v if corner & 2 else np.float32(1) - v) * (u if corner & 1 else np.float32(1) - u) * exponent
                row = address[view] + (y * columns + x) * 4 * run * 2
                for k in range(4):
                    weight = share * rgb[i, k] if k < 3 else share
                    for s in range(0, run, NARROW):
                        _add_halves(total, s, row + (k * run + s) * 2, weight)
            for c in range(channels):
                out[i, c] = total[c] * scale[view, c] + centre[view, c]
