"""Steps on flat float32 arrays, of which kernels are made: WIDE or NARROW numbers at a time, and small matrix products.

A tile of outputs is held in registers while the inputs stream by:

    multiply     out[r, :]  = max(start[r, :] + sum_k x[r, k] w[k, :], floor)     r < ROWS[columns], : = columns vectors of WIDE
    accumulate   out[r, :] += scale[r] (start[r, :] + sum_k x[r, k] w[k, :])

Each output is one sum over k in order, whatever the tile: results do not depend on how a product is cut. Strides are x by row
and by k, w by k, the others by row; `_at` is the first number of each.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator"

from .simd import NARROW, WIDE, exp, load, maximum, narrow, opaque, repeat, splat, store, total, traced

BLOCK = 48
"""Points or rows that kernels take at a time: whole tiles of every shape, small enough for the first-level cache."""
# As many sums as registers hold beside the weights: 24 of 32 on machines with 512 bits, 12 of 16 elsewhere.
ROWS = (0, 16, 12, 8, 6) if WIDE == 16 else (0, 12, 6, 4, 3)
"""Rows of the tile with so many columns of vectors."""


@traced
def copy_lanes(x, at, out, to):
    """out[to : to + WIDE] = x[at : at + WIDE]."""
    store(out, to, load(x, at, WIDE))


@traced
def add_lanes(x, at, y, y_at, out, to):
    """out[to : to + WIDE] = x[at :] + y[y_at :]."""
    store(out, to, load(x, at, WIDE) + load(y, y_at, WIDE))


@traced
def exp_lanes(x, at, out, to):
    """out[to : to + WIDE] = exp(x[at :])."""
    store(out, to, exp(load(x, at, WIDE)))


@traced
def opaque_lanes(x, at, out, to):
    """out[to : to + WIDE] = 1 - exp(-x[at :]), x >= 0."""
    store(out, to, opaque(load(x, at, WIDE)))


@traced
def scaled(x, x_at, factor, y, y_at, out, to):
    """out[to : to + NARROW] = y[y_at :] + factor * x[x_at :]."""
    store(out, to, load(y, y_at, NARROW) + load(x, x_at, NARROW) * narrow(factor, NARROW))


@traced
def dot(x, x_at, y, y_at, count):
    """Sum of x[x_at + i] * y[y_at + i] over i < count, a multiple of NARROW: lanes first, then halves of them."""

    def step(i, sums):
        return [sums[0] + load(x, x_at + i, NARROW) * load(y, y_at + i, NARROW)]

    return total(*repeat(count, [splat(x, 0, NARROW)], step, NARROW))


def _sums(x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, depth, columns):
    """start + x w, a row of vectors after the other."""
    places = [(r, c) for r in range(ROWS[columns]) for c in range(columns)]

    def step(k, sums):
        weights = [load(w, w_at + k * w_step + c * WIDE, WIDE) for c in range(columns)]
        values = [narrow(x[x_at + x_row * r + k * x_step], WIDE) for r in range(ROWS[columns])]
        return [each + values[r] * weights[c] for each, (r, c) in zip(sums, places, strict=True)]

    return zip(places, repeat(depth, [load(start, s_at + s_row * r + c * WIDE, WIDE) for r, c in places], step), strict=True)


@traced
def multiply(x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, out, o_at, o_row, depth, floor, columns):
    """See above. A NaN is not below the floor and stays."""
    for (r, c), value in _sums(x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, depth, columns):
        store(out, o_at + o_row * r + c * WIDE, maximum(narrow(floor, WIDE), value))


@traced
def accumulate(
    x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, out, o_at, o_row, depth, scale, c_at, c_row, columns
):
    """See above."""
    for (r, c), value in _sums(x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, depth, columns):
        o = o_at + o_row * r + c * WIDE
        store(out, o, load(out, o, WIDE) + value * narrow(scale[c_at + c_row * r], WIDE))
