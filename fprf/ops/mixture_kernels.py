"""The compiled loops behind `mixture`: a block of points at a time, nothing between the steps leaves the
cache.

Arrays are flat, contiguous float32. A `width` is a number of outputs rounded up to whole vectors; the padding
of tables is zeros.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .dense_kernels import product
from .simd import (
    BLOCK,
    NARROW,
    WIDE,
    everywhere,
    exp2,
    largest,
    load,
    maximum,
    minimum,
    narrow,
    repeat,
    splat,
    store,
    total,
    traced,
    where_greater,
)
from .threads import cached_jit

_jit = cached_jit(parallel=True, nogil=True)
_NO_FLOOR = np.float32(-np.inf)
_ZERO = np.float32(0)
_ONE = np.float32(1)
_LOWEST = -3e38
"""Below all that is compared; no infinity, of which differences are NaN."""
_LOG2_E = 1 / np.log(2)
_LEAST_EXPONENT = -125.0
"""2^-125 stands for all smaller numbers."""
MANY = 10 * BLOCK
"""Points of a task whose members of a region are multiplied together: a tenth of the rows are padding."""


@traced
def subtract(x, at, centre, out, to, count):
    """out[to :] = x[at :] - centre for `count` numbers, whole vectors; the sum of their squares."""

    def step(k, sums):
        away = load(x, at + k, NARROW) - load(centre, k, NARROW)
        store(out, to + k, away)
        return [sums[0] + away * away]

    (squares,) = repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)
    return total(squares)


@numba.njit(inline="always")
def _directions(x, first, rows, centre, least, away, factor):
    """away[r] = x[first + r] - centre, and what makes one of its length: 0 within `least`. NaN stays."""
    depth = len(centre)
    whole = depth - depth % NARROW
    for r in range(rows):
        square = subtract(x, (first + r) * depth, centre, away, r * depth, whole)
        for c in range(whole, depth):
            apart = x[(first + r) * depth + c] - centre[c]
            away[r * depth + c] = apart
            square += apart * apart
        norm = np.sqrt(square)
        factor[r] = _ZERO if norm <= least else _ONE / norm
    away[rows * depth : BLOCK * depth] = _ZERO


@traced
def softmax(score, at, factor, padding, odds, sharpness, faint, width):
    """score[at : at + width] times a factor becomes shares; those below `faint` of the largest become 0."""
    lowest = splat(score, _LOWEST, WIDE)
    factor = narrow(factor, WIDE)
    sharpness = narrow(sharpness, WIDE)
    faint = narrow(faint, WIDE)

    def scale(k, held):
        scaled = load(score, at + k, WIDE) * factor + load(padding, k, WIDE)
        store(score, at + k, scaled)
        return [maximum(scaled, held[0])]

    def weigh(k, held):
        logit = maximum(lowest, (load(score, at + k, WIDE) - best) * sharpness + load(odds, k, WIDE))
        store(score, at + k, logit)
        return [maximum(logit, held[0])]

    def raised(k, held):
        logit = load(score, at + k, WIDE)
        value = exp2(maximum((logit - top) * _LOG2_E, splat(score, _LEAST_EXPONENT, WIDE)))
        kept = where_greater(faint, value, splat(score, 0.0, WIDE), value)
        store(score, at + k, kept)
        return [held[0] + kept, held[1] + logit * 0.0]

    def divide(k, held):
        store(score, at + k, load(score, at + k, WIDE) * held[0])
        return held

    (found,) = repeat(width, [lowest], scale, by=WIDE)
    best = everywhere(largest(found), WIDE)
    (found,) = repeat(width, [lowest], weigh, by=WIDE)
    top = everywhere(largest(found), WIDE)
    zero = splat(score, 0.0, WIDE)
    found, unknown = repeat(width, [zero, zero], raised, by=WIDE)
    # A comparison passes over NaN; sums do not.
    inverse = 1.0 / everywhere(total(found), WIDE) + everywhere(total(unknown), WIDE)
    repeat(width, [inverse], divide, by=WIDE)


@_jit
def attention(x, centre, least, keys, width, padding, odds, sharpness, faint, out):
    """out [N count] = shares of the directions of points x [N depth] from a centre, among keys [depth width].

    least < 0: points as they are, less the centre. `padding` [width] lowers the scores of what is no key.
    """
    depth = len(centre)
    points = len(x) // depth
    count = len(out) // points
    for task in numba.prange((points + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, points - first)
        away = np.empty(BLOCK * depth, np.float32)
        factor = np.empty(BLOCK, np.float32)
        score = np.empty(BLOCK * width, np.float32)
        none = np.zeros(width, np.float32)
        _directions(x, first, rows, centre, least, away, factor)
        product(away, 0, keys, 0, width, none, 0, 0, score, depth, _NO_FLOOR)
        for r in range(rows):
            by = factor[r] if least >= _ZERO else _ONE
            softmax(score, r * width, by, padding, odds, sharpness, faint, width)
            for k in range(count):
                out[(first + r) * count + k] = score[r * width + k]


@traced
def scaled_row(x, at, centre, gain, shift, g_at, out, to, count):
    """out[to :] = (x[at :] - centre) gain + shift for `count` numbers, whole vectors."""

    def step(k, held):
        away = load(x, at + k, NARROW) - load(centre, k, NARROW)
        store(out, to + k, away * load(gain, g_at + k, NARROW) + load(shift, g_at + k, NARROW))
        return held

    repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)


@numba.njit(inline="always")
def _shares(share, first, rows, count, held):
    """The shares of a block of points, rows of zeros behind them."""
    held[: rows * count] = share[first * count : (first + rows) * count]
    held[rows * count : BLOCK * count] = _ZERO


@_jit
def scaled(x, centre, share, gain, bias, width, out):
    """out [N channels] = (x - centre) (share gain) + share bias, channel by channel; gain, bias [K width]."""
    channels = len(centre)
    points = len(x) // channels
    count = len(share) // points
    whole = channels - channels % NARROW
    for task in numba.prange((points + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, points - first)
        belongs = np.empty(BLOCK * count, np.float32)
        gains = np.empty(BLOCK * width, np.float32)
        shifts = np.empty(BLOCK * width, np.float32)
        none = np.zeros(width, np.float32)
        _shares(share, first, rows, count, belongs)
        product(belongs, 0, gain, 0, width, none, 0, 0, gains, count, _NO_FLOOR)
        product(belongs, 0, bias, 0, width, none, 0, 0, shifts, count, _NO_FLOOR)
        for r in range(rows):
            at = (first + r) * channels
            scaled_row(x, at, centre, gains, shifts, r * width, out, at, whole)
            for c in range(whole, channels):
                mixed = gains[r * width + c]
                out[at + c] = (x[at + c] - centre[c]) * mixed + shifts[r * width + c]


@traced
def take_row(x, at, centre, share, out, to, count):
    """out[to :] = share (x[at :] - centre) for `count` numbers, whole vectors."""

    def step(k, held):
        away = load(x, at + k, NARROW) - load(centre, k, NARROW)
        store(out, to + k, away * narrow(share, NARROW))
        return held

    repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)


@traced
def add_row(x, at, share, bias, b_at, out, to, count):
    """out[to :] += x[at :] + share bias[b_at :] for `count` numbers, whole vectors."""

    def step(k, held):
        more = load(x, at + k, NARROW) + narrow(share, NARROW) * load(bias, b_at + k, NARROW)
        store(out, to + k, load(out, to + k, NARROW) + more)
        return held

    repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)


@_jit
def affine(x, centre, share, matrix, bias, width, out):
    """out [N width] = sum_k share[n, k] ((x[n] - centre) matrix[k] + bias[k]); what has no share costs
    nothing.

    matrix [K channels width], bias [K width].
    """
    channels = len(centre)
    points = len(x) // channels
    count = len(share) // points
    whole = channels - channels % NARROW
    for task in numba.prange((points + MANY - 1) // MANY):
        first = task * MANY
        last = min(points, first + MANY)
        members = np.empty(BLOCK, np.int64)
        weight = np.empty(BLOCK, np.float32)
        taken = np.empty(BLOCK * channels, np.float32)
        moved = np.empty(BLOCK * width, np.float32)
        none = np.zeros(width, np.float32)
        out[first * width : last * width] = _ZERO
        for k in range(count):
            rows = 0
            for n in range(first, last):
                by = share[n * count + k]
                if by != _ZERO:
                    members[rows] = n
                    weight[rows] = by
                    take_row(x, n * channels, centre, by, taken, rows * channels, whole)
                    for c in range(whole, channels):
                        taken[rows * channels + c] = by * (x[n * channels + c] - centre[c])
                    rows += 1
                if rows < BLOCK and (n < last - 1 or rows == 0):
                    continue
                taken[rows * channels : BLOCK * channels] = _ZERO
                table = k * channels * width
                product(taken, 0, matrix, table, width, none, 0, 0, moved, channels, _NO_FLOOR)
                for r in range(rows):
                    to = members[r] * width
                    add_row(moved, r * width, weight[r], bias, k * width, out, to, width)
                rows = 0


@_jit
def coloured(colour, share, maps, width, out):
    """out [N 3] = colour times A plus b, mixed by shares: maps [K width] hold A and below it b, row by row."""
    points = len(colour) // 3
    count = len(share) // points
    for task in numba.prange((points + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, points - first)
        belongs = np.empty(BLOCK * count, np.float32)
        mixed = np.empty(BLOCK * width, np.float32)
        none = np.zeros(width, np.float32)
        _shares(share, first, rows, count, belongs)
        product(belongs, 0, maps, 0, width, none, 0, 0, mixed, count, _NO_FLOOR)
        for r in range(rows):
            at = 3 * (first + r)
            m = r * width
            for c in range(3):
                lit = colour[at] * mixed[m + c] + colour[at + 1] * mixed[m + 3 + c]
                out[at + c] = lit + (colour[at + 2] * mixed[m + 6 + c] + mixed[m + 9 + c])


@numba.njit(inline="always")
def _nearest_mean(near, at, count, size, first, share):
    """Mean of the nearest codes, from the nearest on until `share` of the sizes is full; `near` is used
    up.
    """
    left = share
    mean = _ZERO
    for _ in range(count):
        best = 0
        for t in range(1, count):
            if near[at + t] > near[at + best]:
                best = t
        taken = min(size[first + best], left)
        mean += taken * near[at + best]
        left -= taken
        if left <= _ZERO:
            break
        near[at + best] = np.float32(_LOWEST)
    return mean / (share - left)


@traced
def lesser(score, at, seen, factor, other, padding, p_at, width):
    """score[at :] = the lesser of score times a factor and seen times another, plus the padding; NaN where one
    is, else 0.
    """

    def step(k, unknown):
        one = load(score, at + k, WIDE) * narrow(factor, WIDE)
        two = load(seen, at + k, WIDE) * narrow(other, WIDE)
        store(score, at + k, minimum(one, two) + load(padding, p_at + k, WIDE))
        return [unknown[0] + two * 0.0 + one * 0.0]

    (unknown,) = repeat(width, [splat(score, 0.0, WIDE)], step, by=WIDE)
    return total(unknown)


@_jit
def nearest(
    x,
    centre,
    least,
    middles,
    least_middles,
    codes,
    keys,
    middle_keys,
    width,
    padding,
    sizes,
    share,
    lower,
    out,
):
    """out [N] = over all references the largest mean cosine of a point with its nearest codes.

    A cosine is the lesser of two: from the centre and from the middle of each reference. Reference i has
    codes[i] : codes[i + 1] of the sizes, and keys [references, depth, width] for either. `padding`
    [references, width] lowers what is no code, `lower` [N references] all of them; empty = nothing.
    """
    depth = len(centre)
    points = len(x) // depth
    references = len(codes) - 1
    for task in numba.prange((points + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, points - first)
        away = np.empty(BLOCK * depth, np.float32)
        aside = np.empty(BLOCK * depth, np.float32)
        factor = np.empty(BLOCK, np.float32)
        other = np.empty(BLOCK, np.float32)
        score = np.empty(BLOCK * width, np.float32)
        seen = np.empty(BLOCK * width, np.float32)
        none = np.zeros(width, np.float32)
        found = np.full(BLOCK, -_ONE)
        _directions(x, first, rows, centre, least, away, factor)
        for i in range(references):
            middle = middles[i * depth : (i + 1) * depth]
            _directions(x, first, rows, middle, least_middles[i], aside, other)
            table = i * depth * width
            product(away, 0, keys, table, width, none, 0, 0, score, depth, _NO_FLOOR)
            product(aside, 0, middle_keys, table, width, none, 0, 0, seen, depth, _NO_FLOOR)
            count = codes[i + 1] - codes[i]
            for r in range(rows):
                at = r * width
                less = lower[(first + r) * references + i] if len(lower) > 0 else _ZERO
                # A comparison passes over NaN; sums do not.
                unknown = lesser(score, at, seen, factor[r], other[r], padding, i * width, width)
                mean = _nearest_mean(score, at, count, sizes, codes[i], share)
                found[r] = max(found[r], mean - less) + unknown
        out[first : first + rows] = found[:rows]
