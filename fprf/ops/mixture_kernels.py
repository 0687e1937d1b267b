"""The compiled loops behind `mixture`: a block of points at a time, nothing between the steps leaves the cache.

Arrays are flat, contiguous float32; `width` is a number of outputs rounded up to whole vectors, the padding zeros.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .dense_kernels import ROWS, accumulate, product
from .simd import BLOCK, WIDE, load, store

_jit = numba.njit(parallel=True, cache=True, nogil=True)
_0, _LEAST = np.float32(0), np.float32(-np.inf)


@numba.njit(inline="always", cache=True)
def _any(share, at, step, rows):
    some = False
    for r in range(rows):
        some |= share[at + r * step] != _0
    return some


@numba.njit(inline="always", cache=True)
def _add_scaled(x, x_at, channels, rows, w, w_at, width, bias, b_at, out, share, s_at, count):
    """out[r] += share[r] (bias + x[r] w), tile by tile; tiles without a share are passed over."""
    for c in range(0, width, 4 * WIDE):
        columns = min(4, (width - c) // WIDE)
        for r in range(0, rows, ROWS[columns]):
            if not _any(share, s_at + r * count, count, ROWS[columns]):
                continue
            i, b, o, s = x_at + r * channels, b_at + c, r * width + c, s_at + r * count
            # The shape of a tile is a constant of the compiled code.
            if columns == 4:
                accumulate(x, i, channels, 1, w, w_at + c, width, bias, b, 0, out, o, width, channels, share, s, count, 4)
            elif columns == 3:
                accumulate(x, i, channels, 1, w, w_at + c, width, bias, b, 0, out, o, width, channels, share, s, count, 3)
            elif columns == 2:
                accumulate(x, i, channels, 1, w, w_at + c, width, bias, b, 0, out, o, width, channels, share, s, count, 2)
            else:
                accumulate(x, i, channels, 1, w, w_at + c, width, bias, b, 0, out, o, width, channels, share, s, count, 1)


@_jit
def affine(x, centre, share, matrix, bias, channels, width, out):
    """out [N channels] = sum_k share[n, k] ((x[n] - centre) matrix[k] + bias[k]); what nobody has a share in costs nothing."""
    total = len(x) // channels
    count = len(share) // total
    for task in numba.prange((total + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, total - first)
        sums, belongs = np.zeros(BLOCK * width, np.float32), np.zeros(BLOCK * count, np.float32)
        belongs[: rows * count] = share[first * count : (first + rows) * count]
        away = np.zeros(BLOCK * channels, np.float32)
        for r in range(rows):
            mine, goal = x[(first + r) * channels : (first + r + 1) * channels], away[r * channels : (r + 1) * channels]
            for c in range(channels):
                goal[c] = mine[c] - centre[c]
        # Region by region, the block of points stays in the cache.
        for k in range(count):
            _add_scaled(away, 0, channels, BLOCK, matrix, k * channels * width, width, bias, k * width, sums, belongs, k, count)
        if width == channels:
            for i in range(0, rows * channels, WIDE):
                store(out, first * channels + i, load(sums, i, WIDE))
        else:
            for r in range(rows):
                for c in range(channels):
                    out[(first + r) * channels + c] = sums[r * width + c]


@_jit
def scaled(x, centre, share, gain, bias, channels, width, none, out):
    """out [N channels] = (x - centre) (share gain) + share bias, channel by channel; gain and bias [K width], none zeros."""
    total = len(x) // channels
    count = len(share) // total
    for task in numba.prange((total + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, total - first)
        shares = np.zeros(BLOCK * count, np.float32)
        gains, shift = np.empty(BLOCK * width, np.float32), np.empty(BLOCK * width, np.float32)
        shares[: rows * count] = share[first * count : (first + rows) * count]
        # Mixed gains and biases of each point, then their use.
        product(shares, 0, count, 1, rows, gain, 0, width, none, 0, 0, gains, 0, width, count, _LEAST)
        product(shares, 0, count, 1, rows, bias, 0, width, none, 0, 0, shift, 0, width, count, _LEAST)
        for r in range(rows):
            mine, goal = x[(first + r) * channels : (first + r + 1) * channels], out[(first + r) * channels :]
            factor, more = gains[r * width :], shift[r * width :]
            for c in range(channels):
                goal[c] = (mine[c] - centre[c]) * factor[c] + more[c]
