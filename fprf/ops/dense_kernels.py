"""The compiled loops behind `dense`: small networks, a block of rows at a time, nothing between the layers
leaves the cache.

Arrays are flat, contiguous float32. Weights lie layer after layer as [inputs, width], biases as [width];
widths are whole vectors (padded with zeros), and the padding of one layer's outputs meets zero weights in the
next.

A product is made of tiles, whose outputs are held in registers while the inputs stream by:

    out[r, :] = max(start[r, :] + sum_k x[r, k] w[k, :], floor)     r < ROWS[columns], : = columns vectors of WIDE

Each output is one sum over k in order, whatever the tile: results do not depend on how a product is cut. Rows
of x follow each other, `depth` numbers each; strides are w by k, the others by row; `_at` is the first number
of each.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .simd import BLOCK, WIDE, load, maximum, narrow, repeat, splat, store, traced, where_greater
from .threads import cached_jit

_jit = cached_jit(parallel=True, nogil=True)
_NO_FLOOR = np.float32(-np.inf)
# As many sums as registers hold beside the weights: 24 of 32 on machines with 512 bits, 12 of 16 elsewhere.
ROWS = (0, 16, 12, 8, 6) if WIDE == 16 else (0, 12, 6, 4, 3)
"""Rows of the tile with so many columns of vectors."""


@traced
def multiply(x, x_at, w, w_at, w_step, start, s_at, s_row, out, o_at, depth, floor, columns):
    """A tile of outputs from the floor on. A NaN is not below it and stays."""
    places = []
    for r in range(ROWS[columns]):
        places += [(r, c) for c in range(columns)]

    def step(k, sums):
        weights = [load(w, w_at + k * w_step + c * WIDE, WIDE) for c in range(columns)]
        values = [narrow(x[x_at + depth * r + k], WIDE) for r in range(ROWS[columns])]
        return [each + values[r] * weights[c] for each, (r, c) in zip(sums, places, strict=True)]

    begin = [load(start, s_at + s_row * r + c * WIDE, WIDE) for r, c in places]
    for (r, c), value in zip(places, repeat(depth, begin, step), strict=True):
        store(out, o_at + w_step * r + c * WIDE, maximum(narrow(floor, WIDE), value))


@numba.njit(inline="always")
def product(x, x_at, w, w_at, width, start, s_at, s_row, out, depth, floor):
    """out[r] = max(start[r] + x[r] w, floor) for a block of rows of `width`."""
    for c in range(0, width, 4 * WIDE):
        columns = min(4, (width - c) // WIDE)
        for r in range(0, BLOCK, ROWS[columns]):
            i = x_at + r * depth
            s = s_at + r * s_row + c
            o = r * width + c
            # The shape of a tile is a constant of the compiled code.
            if columns == 4:
                multiply(x, i, w, w_at + c, width, start, s, s_row, out, o, depth, floor, 4)
            elif columns == 3:
                multiply(x, i, w, w_at + c, width, start, s, s_row, out, o, depth, floor, 3)
            elif columns == 2:
                multiply(x, i, w, w_at + c, width, start, s, s_row, out, o, depth, floor, 2)
            else:
                multiply(x, i, w, w_at + c, width, start, s, s_row, out, o, depth, floor, 1)


@traced
def add_shift(bias, at, side, s_at, out, to):
    """out[to : to + WIDE] = bias[at :] + side[s_at :]."""
    store(out, to, load(bias, at, WIDE) + load(side, s_at, WIDE))


@numba.njit(inline="always")
def _shifted(biases, side, row, first, rows, width, out):
    """out[r] = biases + side[row[first + r]] for a block of rows; 0 where they end."""
    for r in range(rows):
        for c in range(0, width, WIDE):
            add_shift(biases, c, side, row[first + r] * width + c, out, r * width + c)
    out[rows * width : BLOCK * width] = np.float32(0)


@numba.njit(inline="always")
def _layers(source, at, depth, weights, biases, widths, side, row, first, rows, here, there, out, outputs):
    """A block of rows of `source` through all layers, to rows `first` on of `out`; `source` may be
    `there`.
    """
    # Sums start from the biases, or from these and what is shared.
    start = biases
    s_row = 0
    if len(row) > 0:
        start = here
        s_row = widths[0]
        _shifted(biases, side, row, first, rows, widths[0], here)
    w_at = 0
    b_at = 0
    layers = len(widths)
    for layer in range(layers):
        width = widths[layer]
        floor = np.float32(0) if layer < layers - 1 else _NO_FLOOR
        # Sums that start from `here` may end there: a tile is read whole before it is written.
        goal = here if layer % 2 == 0 else there
        product(source, at, weights, w_at, width, start, b_at, s_row, goal, depth, floor)
        w_at = w_at + depth * width
        b_at = b_at + width
        start = biases
        s_row = 0
        source = goal
        at = 0
        depth = width
    if depth == outputs:
        for i in range(0, rows * outputs, WIDE):
            store(out, first * outputs + i, load(source, i, WIDE))
    else:
        for r in range(rows):
            for c in range(outputs):
                out[(first + r) * outputs + c] = source[r * depth + c]


@_jit
def network(x, inputs, weights, biases, widths, side, row, out, outputs):
    """out [N outputs] = the network of x [N inputs]: ReLU between layers.

    `side` [rows, first width] is added before the first ReLU, row[n] of it to point n; both empty = nothing.
    """
    count = len(out) // outputs
    broad = inputs
    for width in widths:
        broad = max(broad, width)
    for task in numba.prange((count + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, count - first)
        here = np.empty(BLOCK * broad, np.float32)
        there = np.empty(BLOCK * broad, np.float32)
        source = x
        at = first * inputs
        if rows < BLOCK:
            source = there
            at = 0
            there[: rows * inputs] = x[first * inputs : (first + rows) * inputs]
            there[rows * inputs : BLOCK * inputs] = np.float32(0)
        _layers(
            source, at, inputs, weights, biases, widths, side, row, first, rows, here, there, out, outputs
        )


# In training every layer is kept. Its three products are one layer forward, the same with the weights as they
# are for the gradient of its inputs, and `outer` for that of its weights.
OUTER_ROWS = 4
"""Outputs of a tile of `outer`."""
_OUTER_COLUMNS = 4 if WIDE == 16 else 2
"""Vectors of inputs of a tile: 16 sums of 32 registers, or 8 of 16."""
_OUTER_POINTS = 128
"""Points that all tiles take before the next ones: they and their gradients lie in the caches; by eye."""


@traced
def keep_positive(x, at, mask, m_at, out, to):
    """out[to : to + WIDE] = x[at :] where mask[m_at :] is above 0, else 0."""
    zero = splat(x, 0.0, WIDE)
    store(out, to, where_greater(load(mask, m_at, WIDE), zero, load(x, at, WIDE), zero))


@_jit
def linear(x, weights, biases, side, row, mask, out):
    """out [N outputs] = max(x [N inputs] weights + biases, floor), and 0 where `mask` [N outputs] is not above
    0, if it is given. The floor stands behind the biases; `side` and `row` as of `network`.
    """
    width = len(biases) - 1
    floor = biases[width]
    inputs = len(weights) // width
    count = len(x) // inputs
    outputs = len(out) // count
    for task in numba.prange((count + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        rows = min(BLOCK, count - first)
        here = np.empty(BLOCK * width, np.float32)
        source = x
        at = first * inputs
        if rows < BLOCK:
            source = np.zeros(BLOCK * inputs, np.float32)
            at = 0
            source[: rows * inputs] = x[first * inputs : (first + rows) * inputs]
        if len(row) > 0:
            _shifted(biases, side, row, first, rows, width, here)
            product(source, at, weights, 0, width, here, 0, width, here, inputs, floor)
        else:
            product(source, at, weights, 0, width, biases, 0, 0, here, inputs, floor)
        if width == outputs:
            to = first * outputs
            for i in range(0, rows * outputs, WIDE):
                if len(mask) > 0:
                    keep_positive(here, i, mask, to + i, out, to + i)
                else:
                    store(out, to + i, load(here, i, WIDE))
        else:
            for r in range(rows):
                for c in range(outputs):
                    to = (first + r) * outputs + c
                    kept = len(mask) == 0 or mask[to] > np.float32(0)
                    out[to] = here[r * width + c] if kept else np.float32(0)


@traced
def add_outer(g, x, out, firsts, steps, count, columns):
    """out[r, :] += sum over `count` points n of g[n, r] x[n, :] for OUTER_ROWS rows, : = columns vectors.

    `firsts` are the first numbers of g, x and out, `steps` those from one row of g, and of x and out, to the
    next.
    """
    g_at, x_at, o_at = firsts
    g_step, x_step = steps
    places = []
    for r in range(OUTER_ROWS):
        places += [(r, c) for c in range(columns)]

    def step(n, sums):
        inputs = [load(x, x_at + n * x_step + c * WIDE, WIDE) for c in range(columns)]
        values = [narrow(g[g_at + n * g_step + r], WIDE) for r in range(OUTER_ROWS)]
        return [each + values[r] * inputs[c] for each, (r, c) in zip(sums, places, strict=True)]

    begin = [load(out, o_at + x_step * r + c * WIDE, WIDE) for r, c in places]
    for (r, c), value in zip(places, repeat(count, begin, step), strict=True):
        store(out, o_at + x_step * r + c * WIDE, value)


@_jit
def outer(g, outputs, x, inputs, slices, out):
    """Add to out [slices outputs inputs] the products g [N outputs]^T x [N inputs], each of a slice of the
    points.

    Outputs are a multiple of OUTER_ROWS, inputs of WIDE.
    """
    count = len(g) // outputs
    for part in numba.prange(slices):
        end = (part + 1) * count // slices
        for first in range(part * count // slices, end, _OUTER_POINTS):
            points = min(_OUTER_POINTS, end - first)
            steps = (outputs, inputs)
            for o in range(0, outputs, OUTER_ROWS):
                at = (part * outputs + o) * inputs
                for i in range(0, inputs, _OUTER_COLUMNS * WIDE):
                    columns = min(_OUTER_COLUMNS, (inputs - i) // WIDE)
                    firsts = (first * outputs + o, first * inputs + i, at + i)
                    if columns == 4:
                        add_outer(g, x, out, firsts, steps, points, 4)
                    elif columns == 3:
                        add_outer(g, x, out, firsts, steps, points, 3)
                    elif columns == 2:
                        add_outer(g, x, out, firsts, steps, points, 2)
                    else:
                        add_outer(g, x, out, firsts, steps, points, 1)
