"""The compiled loops behind `dense`: small networks, a block of rows at a time, nothing between the layers leaves the cache.

Arrays are flat, contiguous float32. Weights lie layer after layer as [inputs, width], biases as [width]; widths are whole
vectors (padded with zeros), and the padding of one layer's outputs meets zero weights in the next.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .lanes import BLOCK, ROWS, add_lanes, copy_lanes, multiply
from .simd import WIDE

_jit = numba.njit(parallel=True, cache=True, nogil=True)
_LEAST = np.float32(-np.inf)


@numba.njit(inline="always", cache=True)
def product(x, x_at, x_row, x_step, rows, w, w_at, width, start, s_at, s_row, out, o_at, o_row, depth, floor):
    """out[r] = max(start[r] + x[r] w, floor) for `rows` rows (whole tiles: a divisor or multiple of BLOCK) of `width`."""
    for c in range(0, width, 4 * WIDE):
        columns = min(4, (width - c) // WIDE)
        for r in range(0, rows, ROWS[columns]):
            i, s, o = x_at + r * x_row, s_at + r * s_row + c, o_at + r * o_row + c
            # The shape of a tile is a constant of the compiled code.
            if columns == 4:
                multiply(x, i, x_row, x_step, w, w_at + c, width, start, s, s_row, out, o, o_row, depth, floor, 4)
            elif columns == 3:
                multiply(x, i, x_row, x_step, w, w_at + c, width, start, s, s_row, out, o, o_row, depth, floor, 3)
            elif columns == 2:
                multiply(x, i, x_row, x_step, w, w_at + c, width, start, s, s_row, out, o, o_row, depth, floor, 2)
            else:
                multiply(x, i, x_row, x_step, w, w_at + c, width, start, s, s_row, out, o, o_row, depth, floor, 1)


@numba.njit(inline="always", cache=True)
def _layers(source, at, depth, weights, biases, widths, side, row, last, first, rows, here, there, out, outputs):
    """A block of rows of `source` through all layers, to rows `first` on of `out`; `source` may be `there`."""
    start, s_row = biases, 0
    if len(row) > 0:
        width, start, s_row = widths[0], here, widths[0]
        for r in range(rows):
            for c in range(0, width, WIDE):
                add_lanes(biases, c, side, row[first + r] * width + c, here, r * width + c)
        here[rows * width : BLOCK * width] = np.float32(0)
    w_at, b_at, layers = 0, 0, len(widths)
    for layer in range(layers):
        width = widths[layer]
        floor = np.float32(0) if layer < layers - 1 or last == 1 else _LEAST
        # Sums that start from `here` may end there: a tile is read whole before it is written.
        goal = here if layer % 2 == 0 else there
        product(source, at, depth, 1, BLOCK, weights, w_at, width, start, b_at, s_row, goal, 0, width, depth, floor)
        w_at, b_at = w_at + depth * width, b_at + width
        start, s_row, source, at, depth = biases, 0, goal, 0, width
    if depth == outputs:
        for i in range(0, rows * outputs, WIDE):
            copy_lanes(source, i, out, first * outputs + i)
    else:
        for r in range(rows):
            for c in range(outputs):
                out[(first + r) * outputs + c] = source[r * depth + c]


@_jit
def network(x, inputs, weights, biases, widths, side, row, last, out, outputs):
    """out [N outputs] = the network of x [N inputs]: ReLU between layers; last: 0 nothing, 1 ReLU.

    `side` [rows, first width] is added before the first ReLU, row[n] of it to point n; both empty = nothing.
    """
    count, broad = len(out) // outputs, inputs
    for width in widths:
        broad = max(broad, width)
    for task in numba.prange((count + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, count - first)
        here, there = np.empty(BLOCK * broad, np.float32), np.empty(BLOCK * broad, np.float32)
        source, at = x, first * inputs
        if rows < BLOCK:
            source, at = there, 0
            there[: rows * inputs] = x[first * inputs : (first + rows) * inputs]
            there[rows * inputs : BLOCK * inputs] = np.float32(0)
        _layers(source, at, inputs, weights, biases, widths, side, row, last, first, rows, here, there, out, outputs)


@numba.njit(cache=True, nogil=True)
def runs(x, first, run):
    """Number of runs of equal rows of x [N C]; first row of each, and the run of each row."""
    count = 0
    for n in range(len(x)):
        same = n > 0
        for c in range(x.shape[1]):
            same = same and x[n, c] == x[n - 1, c]
        if not same:
            first[count] = n
            count += 1
        run[n] = count - 1
    return count
