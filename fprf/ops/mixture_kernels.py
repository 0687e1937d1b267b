"""The compiled loops behind `mixture`: a block of points at a time, nothing between the steps leaves the cache.

Arrays are flat, contiguous float32; `width` is a number of outputs rounded up to whole vectors, the padding zeros.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .dense_kernels import ROWS, accumulate, product
from .simd import BLOCK, NARROW, WIDE, dot, exp, load, store
from .simd import scaled as scaled_lanes

_jit = numba.njit(parallel=True, cache=True, nogil=True)
_0, _1, _LEAST = np.float32(0), np.float32(1), np.float32(-np.inf)


@numba.njit(inline="always", cache=True)
def _away(x, first, rows, centre, least, away, factor):
    """away[r] = x[first + r] - centre, and one by its length, 0 within `least`; NaN stays."""
    depth = len(centre)
    whole = depth - depth % NARROW
    for r in range(rows):
        at, to = (first + r) * depth, r * depth
        for c in range(0, whole, NARROW):
            scaled_lanes(centre, c, np.float32(-1), x, at + c, away, to + c)
        for c in range(whole, depth):
            away[to + c] = x[at + c] - centre[c]
        square = dot(away, to, away, to, whole)
        for c in range(whole, depth):
            square += away[to + c] * away[to + c]
        norm = np.sqrt(square)
        factor[r] = _1 / norm if norm > least else _0 * norm


@numba.njit(inline="always", cache=True)
def _softmax(score, count, factor, sharpness, odds, faint, best, total):
    """Shares of each column of score [rows BLOCK] times its factor, in place; those below `faint` of the best become 0."""
    block = score.shape[1]
    for r in range(block):
        best[r] = _LEAST
    for k in range(count):
        for r in range(block):
            score[k, r] *= factor[r]
            best[r] = max(best[r], score[k, r])
    for r in range(block):
        total[r] = _LEAST
    for k in range(count):
        for r in range(block):
            score[k, r] = (score[k, r] - best[r]) * sharpness + odds[k]
            total[r] = max(total[r], score[k, r])
    for k in range(count):
        for r in range(block):
            score[k, r] -= total[r]
    flat = score.reshape(-1)
    for i in range(0, count * block, WIDE):
        store(flat, i, exp(load(flat, i, WIDE)))
    for r in range(block):
        total[r] = _0
    for k in range(count):
        for r in range(block):
            # The best has exp(0) = 1, so this is a share of it. A NaN is not below and stays.
            score[k, r] = _0 if score[k, r] < faint else score[k, r]
            total[r] += score[k, r]
    for r in range(block):
        total[r] = _1 / total[r]
    for k in range(count):
        for r in range(block):
            score[k, r] *= total[r]


@_jit
def attention(x, centre, least, keys, width, sharpness, odds, faint, none, out):
    """out [N count] = softmax of the scores of points x [N depth] with keys [depth width], count = len(odds) <= width.

    least >= 0: points are directions from the centre, and none within `least` of it. least < 0: points as they are.
    """
    count, depth = len(odds), len(centre)
    total = len(out) // count
    for task in numba.prange((total + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        points = min(BLOCK, total - first)
        side, score = np.empty(BLOCK * width, np.float32), np.empty((count, BLOCK), np.float32)
        factor, best, sums = np.ones(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        source, at = x, first * depth
        if least >= _0 or points < BLOCK:
            source, at = np.zeros(BLOCK * depth, np.float32), 0
            if least >= _0:
                _away(x, first, points, centre, least, source, factor)
            else:
                source[: points * depth] = x[first * depth : (first + points) * depth]
        product(source, at, depth, 1, BLOCK, keys, 0, width, none, 0, 0, side, 0, width, depth, _LEAST)
        # Points side by side: from here on a vector holds one number of several points.
        for r in range(BLOCK):
            for k in range(count):
                score[k, r] = side[r * width + k]
        _softmax(score, count, factor, sharpness, odds, faint, best, sums)
        for r in range(points):
            mine = out[(first + r) * count : (first + r + 1) * count]
            for k in range(count):
                mine[k] = score[k, r]


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
        product(shares, 0, count, 1, rows, gain, 0, width, none, 0, 0, gains, 0, width, count, _LEAST)
        product(shares, 0, count, 1, rows, bias, 0, width, none, 0, 0, shift, 0, width, count, _LEAST)
        for r in range(rows):
            mine, goal = x[(first + r) * channels : (first + r + 1) * channels], out[(first + r) * channels :]
            factor, more = gains[r * width :], shift[r * width :]
            for c in range(channels):
                goal[c] = (mine[c] - centre[c]) * factor[c] + more[c]
