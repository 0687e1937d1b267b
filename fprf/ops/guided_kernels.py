"""Features at pixels from half-precision coefficients: `guided.apply`, compiled by numba on first use and
cached.

Layout: one row a stored cell, four runs of P channels (A for red, green and blue, then b), as the bits of
float16. P is C rounded up to whole vectors of NARROW. 4096 pixels x 48 channels take 0.6 ms of one core where
the coefficients are in its cache, 2.5 ms over 43 views that are not.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg"

import numba
import numpy as np

from .simd import NARROW, load, load_halves, narrow, store, traced
from .threads import cached_jit

PIXELS = 64
"""Pixels of a task."""


@traced
def _add_halves(total, at, address, weight):
    """total[at : at + NARROW] += weight * 2^-112 * the float16 numbers whose bits lie at an address."""
    store(total, at, load(total, at, NARROW) + load_halves(address, NARROW) * narrow(weight, NARROW))


@numba.njit(inline="always")
def _corner(position, cells):
    """Lower cell, upper cell, share of the upper one; NaN falls on the lower border: no index may leave the
    table.
    """
    at = position - np.float32(0.5)
    at = min(at, np.float32(cells - 1)) if at > np.float32(0) else np.float32(0)
    low = int(at)
    return low, min(low + 1, cells - 1), at - np.float32(low)


@cached_jit(parallel=True, nogil=True, fastmath={"contract"})
def gather(slot, address, shape, scale, centre, run, pixel, rgb, out):
    """out[i] [R C] = F = scale (A I + b) + centre at pixel[i] [R 2] with the colour I = rgb[i] [R 3] of the
    view slot[i].

    Of V views: `address` of their coefficients [rows columns 4 P] and `shape` [V 4], which is rows, columns,
    height and width; scale and centre [V C]; run = P.
    """
    channels = scale.shape[1]
    exponent = np.float32(2.0**112)
    for task in numba.prange((len(slot) + PIXELS - 1) // PIXELS):
        total = np.empty(run, dtype=np.float32)
        for i in range(task * PIXELS, min(len(slot), task * PIXELS + PIXELS)):
            view = slot[i]
            rows = shape[view, 0]
            columns = shape[view, 1]
            vertical = np.float32(rows / shape[view, 2])
            horizontal = np.float32(columns / shape[view, 3])
            # The four cells around the pixel.
            top, bottom, v = _corner(pixel[i, 1] * vertical, rows)
            left, right, u = _corner(pixel[i, 0] * horizontal, columns)
            total[:] = np.float32(0)
            for corner in range(4):
                y = bottom if corner & 2 else top
                x = right if corner & 1 else left
                share = (
                    (v if corner & 2 else np.float32(1) - v)
                    * (u if corner & 1 else np.float32(1) - u)
                    * exponent
                )
                row = address[view] + (y * columns + x) * 4 * run * 2
                for k in range(4):
                    weight = share * rgb[i, k] if k < 3 else share
                    for s in range(0, run, NARROW):
                        _add_halves(total, s, row + (k * run + s) * 2, weight)
            for c in range(channels):
                out[i, c] = total[c] * scale[view, c] + centre[view, c]
