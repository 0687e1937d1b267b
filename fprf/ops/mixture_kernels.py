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
"""In float32, as all numbers of these loops."""
_ONE = np.float32(1)
"""In float32."""
_LOWEST = -3e38
"""Below all that is compared; no infinity, of which differences are NaN."""
_LOG2_E = 1 / np.log(2)
"""exp(x) is 2 to this times x."""
_LEAST_EXPONENT = -125.0
"""2^-125 stands for all smaller numbers."""
MANY = 10 * BLOCK
"""Points of a task whose members of a region are multiplied together; by eye."""


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
def softmax(score, at, factor, odds, softness, width):
    """score[at : at + width] times a factor becomes shares but for a factor, which is returned; those below
    `faint` of the largest become 0.

    `odds` hold what is added to scores, and behind it to logits; `softness` 1 / temperature and `faint`.
    """
    lowest = splat(score, _LOWEST, WIDE)
    factor = narrow(factor, WIDE)
    sharpness = narrow(softness[0], WIDE)
    faint = narrow(softness[1], WIDE)

    def scale(k, held):
        scaled = load(score, at + k, WIDE) * factor + load(odds, k, WIDE)
        store(score, at + k, scaled)
        return [maximum(scaled, held[0])]

    def weigh(k, held):
        logit = (load(score, at + k, WIDE) - best) * sharpness + load(odds, width + k, WIDE)
        logit = maximum(lowest, logit)
        store(score, at + k, logit)
        return [maximum(logit, held[0])]

    def raised(k, held):
        logit = load(score, at + k, WIDE)
        value = exp2(maximum((logit - top) * _LOG2_E, splat(score, _LEAST_EXPONENT, WIDE)))
        kept = where_greater(faint, value, splat(score, 0.0, WIDE), value)
        store(score, at + k, kept)
        return [held[0] + kept, held[1] + logit * 0.0]

    (found,) = repeat(width, [lowest], scale, by=WIDE)
    best = everywhere(largest(found), WIDE)
    (found,) = repeat(width, [lowest], weigh, by=WIDE)
    top = everywhere(largest(found), WIDE)
    zero = splat(score, 0.0, WIDE)
    found, unknown = repeat(width, [zero, zero], raised, by=WIDE)
    # A comparison passes over NaN; sums do not.
    return largest(1.0 / everywhere(total(found), WIDE) + everywhere(total(unknown), WIDE))


@traced
def times(x, at, factor, out, to, count):
    """out[to :] = x[at :] factor for `count` numbers, whole vectors."""

    def step(k, held):
        store(out, to + k, load(x, at + k, NARROW) * narrow(factor, NARROW))
        return held

    repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)


@_jit
def attention(x, centre, least, keys, odds, softness, out):
    """out [N count] = shares of the directions of points x [N depth] from a centre, among keys [depth width].

    least < 0: points as they are, less the centre. `odds` [2 width] and `softness` as of `softmax`.
    """
    depth = len(centre)
    width = len(odds) // 2
    points = len(x) // depth
    count = len(out) // points
    vectors = count - count % NARROW
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
            whole = softmax(score, r * width, by, odds, softness, width)
            to = (first + r) * count
            times(score, r * width, whole, out, to, vectors)
            for k in range(vectors, count):
                out[to + k] = score[r * width + k] * whole


@traced
def scaled_row(x, at, centre, mixed, m_at, widths, out):
    """out[at :] = (x[at :] - centre) gain + shift for widths[0] numbers, whole vectors.

    The gains begin at mixed[m_at], the shifts widths[1] behind them.
    """
    count, width = widths

    def step(k, held):
        away = load(x, at + k, NARROW) - load(centre, k, NARROW)
        gain = load(mixed, m_at + k, NARROW)
        store(out, at + k, away * gain + load(mixed, m_at + width + k, NARROW))
        return held

    repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)


@numba.njit(inline="always")
def _shares(share, first, rows, count, held):
    """The shares of a block of points, rows of zeros behind them."""
    held[: rows * count] = share[first * count : (first + rows) * count]
    held[rows * count : BLOCK * count] = _ZERO


@_jit
def scaled(x, centre, share, table, width, out):
    """out [N channels] = (x - centre) (share gain) + share bias, channel by channel.

    table [K 2 width]: the gain and the bias of each region, side by side.
    """
    channels = len(centre)
    points = len(x) // channels
    count = len(share) // points
    whole = channels - channels % NARROW
    for task in numba.prange((points + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, points - first)
        belongs = np.empty(BLOCK * count, np.float32)
        mixed = np.empty(2 * BLOCK * width, np.float32)
        none = np.zeros(2 * width, np.float32)
        _shares(share, first, rows, count, belongs)
        product(belongs, 0, table, 0, 2 * width, none, 0, 0, mixed, count, _NO_FLOOR)
        for r in range(rows):
            at = (first + r) * channels
            m = 2 * r * width
            scaled_row(x, at, centre, mixed, m, (whole, width), out)
            for c in range(whole, channels):
                out[at + c] = (x[at + c] - centre[c]) * mixed[m + c] + mixed[m + width + c]


@traced
def take_row(x, at, centre, share, out, to, count):
    """out[to :] = share (x[at :] - centre) for `count` numbers, whole vectors."""

    def step(k, held):
        away = load(x, at + k, NARROW) - load(centre, k, NARROW)
        store(out, to + k, away * narrow(share, NARROW))
        return held

    repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)


@traced
def add_row(x, at, out, to, count):
    """out[to :] += x[at :] for `count` numbers, whole vectors."""

    def step(k, held):
        store(out, to + k, load(out, to + k, NARROW) + load(x, at + k, NARROW))
        return held

    repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)


@_jit
def affine(x, centre, share, maps, width, out):
    """out [N width] = sum_k share[n, k] ((x[n] - centre) A_k + b_k); what has no share costs nothing.

    maps [K channels+1 width]: A and below it b of each region.
    """
    channels = len(centre)
    depth = channels + 1
    points = len(x) // channels
    count = len(share) // points
    whole = channels - channels % NARROW
    for task in numba.prange((points + MANY - 1) // MANY):
        first = task * MANY
        last = min(points, first + MANY)
        members = np.empty(BLOCK, np.int64)
        taken = np.empty(BLOCK * depth, np.float32)
        moved = np.empty(BLOCK * width, np.float32)
        none = np.zeros(width, np.float32)
        out[first * width : last * width] = _ZERO
        for k in range(count):
            rows = 0
            for n in range(first, last):
                by = share[n * count + k]
                if by != _ZERO:
                    members[rows] = n
                    take_row(x, n * channels, centre, by, taken, rows * depth, whole)
                    for c in range(whole, channels):
                        taken[rows * depth + c] = by * (x[n * channels + c] - centre[c])
                    taken[rows * depth + channels] = by
                    rows += 1
                if rows < BLOCK and (n < last - 1 or rows == 0):
                    continue
                taken[rows * depth : BLOCK * depth] = _ZERO
                product(taken, 0, maps, k * depth * width, width, none, 0, 0, moved, depth, _NO_FLOOR)
                for r in range(rows):
                    add_row(moved, r * width, out, members[r] * width, width)
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
def _nearest_mean(near, at, sizes, count):
    """Mean of the nearest of `count` codes, from the nearest on until their sizes sum to 1; `near` is used
    up.
    """
    left = _ONE
    mean = _ZERO
    for _ in range(count):
        best = 0
        for t in range(1, count):
            if near[at + t] > near[at + best]:
                best = t
        taken = min(sizes[best], left)
        mean += taken * near[at + best]
        left -= taken
        if left <= _ZERO:
            break
        near[at + best] = np.float32(_LOWEST)
    return mean / (_ONE - left)


@traced
def lesser(score, at, seen, factors, table, t_at, width):
    """score[at :] = the lesser of score and seen, each times its factor, plus the table; NaN where one is,
    else 0.
    """

    def step(k, unknown):
        one = load(score, at + k, WIDE) * narrow(factors[0], WIDE)
        two = load(seen, at + k, WIDE) * narrow(factors[1], WIDE)
        store(score, at + k, minimum(one, two) + load(table, t_at + k, WIDE))
        return [unknown[0] + two * 0.0 + one * 0.0]

    (unknown,) = repeat(width, [splat(score, 0.0, WIDE)], step, by=WIDE)
    return total(unknown)


@_jit
def nearest(x, views, least, keys, table, lower, out):
    """out [N] = over all references the largest mean cosine of a point with its nearest codes.

    A cosine is the lesser of two: from the centre, views[0], and from the middle of each reference, behind it;
    within `least` of either a point has no direction. keys [2 references depth width] are directions of codes
    from the one and from the other. table [2 references width] lowers what is no code, and holds sizes of
    codes: the nearest are taken until these sum to 1. `lower` [N references] is subtracted; empty = nothing.
    """
    references = len(least) - 1
    depth = len(views) // (references + 1)
    width = len(table) // (2 * references)
    points = len(x) // depth
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
        _directions(x, first, rows, views[:depth], least[0], away, factor)
        for i in range(references):
            middle = views[(i + 1) * depth : (i + 2) * depth]
            _directions(x, first, rows, middle, least[i + 1], aside, other)
            here = i * depth * width
            there = (references + i) * depth * width
            product(away, 0, keys, here, width, none, 0, 0, score, depth, _NO_FLOOR)
            product(aside, 0, keys, there, width, none, 0, 0, seen, depth, _NO_FLOOR)
            sizes = table[(references + i) * width : (references + i + 1) * width]
            count = width
            while count > 1 and sizes[count - 1] == _ZERO:
                count -= 1
            for r in range(rows):
                at = r * width
                less = lower[(first + r) * references + i] if len(lower) > 0 else _ZERO
                # A comparison passes over NaN; sums do not.
                unknown = lesser(score, at, seen, (factor[r], other[r]), table, i * width, width)
                mean = _nearest_mean(score, at, sizes, count)
                found[r] = max(found[r], mean - less) + unknown
        out[first : first + rows] = found[:rows]
