"""Gradients of `dense_kernels.network`: a block of points from the last layer to the first, nothing between leaves the cache.

Points are cut into CHUNKS ranges whose sums over points are added up in order: bitwise the same for any number of threads.
Arrays are flat, contiguous float32, padded as in `dense_kernels`; sums of weights have rows for whole blocks of inputs.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .dense_kernels import product
from .lanes import BLOCK, WIDE
from .rows import add_lanes, copy_lanes, mask_lanes

__all__ = ["CHUNKS", "gradients"]

CHUNKS = 8
"""Ranges of points with sums of their own: enough for eight threads."""
_LEAST = np.float32(-np.inf)


@numba.njit(inline="always", cache=True)
def _row(source, at, width, out, to, stride):
    """`width` numbers, and zeros up to `stride`."""
    whole = width // WIDE * WIDE
    for c in range(0, whole, WIDE):
        copy_lanes(source, at + c, out, to + c)
    for c in range(whole, width):
        out[to + c] = source[at + c]
    for c in range(width, stride):
        out[to + c] = np.float32(0)


@numba.njit(inline="always", cache=True)
def _load(source, at, rows, width, out, stride):
    """`rows` rows of the source into a scratch block of rows of `stride`, zeros behind each."""
    for r in range(rows):
        _row(source, at + r * width, width, out, r * stride, stride)


@numba.njit(inline="always", cache=True)
def _back(y, grad, first, rows, outputs, width, last, out):
    """The gradient before the last activation, padded to whole vectors."""
    _load(grad, first * outputs, rows, outputs, out, width)
    out[rows * width : BLOCK * width] = np.float32(0)
    for r in range(rows if last == 1 else 0):
        for c in range(outputs):
            if not y[(first + r) * outputs + c] > np.float32(0):
                out[r * width + c] = np.float32(0)


@numba.njit(parallel=True, cache=True, nogil=True)
def gradients(
    x, inputs, shared, across, row, hidden, widths, transposed, y, outputs, last, grad, sums, starts, shifts, learns, out
):
    """From `grad` [N outputs], the gradient of the outputs y: that of x to `out` [N inputs], if it is not empty, and sums.

    `transposed`: weights layer after layer [width, inputs padded]. `sums` [CHUNKS ...] gets the gradients of the weights,
    layer l from starts[l] on as [inputs in whole blocks, width], those of the inputs `shared` [rows, across] from starts[-1]
    on, those of the biases from shifts[l] on; nothing where `learns` is false.
    """
    count, layers = len(grad) // outputs, len(widths)
    size = len(sums) // CHUNKS
    blocks = (count + BLOCK - 1) // BLOCK
    broad = max(inputs, across)
    for width in widths:
        broad = max(broad, width)
    broad = (broad + BLOCK - 1) // BLOCK * BLOCK
    for chunk in numba.prange(CHUNKS):
        g, behind = np.empty(BLOCK * broad, np.float32), np.empty(BLOCK * broad, np.float32)
        given, none = np.empty(BLOCK * broad, np.float32), np.zeros(broad, np.float32)
        mine = chunk * size
        for block in range(chunk * blocks // CHUNKS, (chunk + 1) * blocks // CHUNKS):
            first = block * BLOCK
            rows = min(BLOCK, count - first)
            _back(y, grad, first, rows, outputs, widths[layers - 1], last, g)
            w_at, kept = len(transposed), len(hidden)
            for back in range(layers):
                layer = layers - 1 - back
                width = widths[layer]
                depth = inputs if layer == 0 else widths[layer - 1]
                padded = (depth + WIDE - 1) // WIDE * WIDE
                stride = (depth + BLOCK - 1) // BLOCK * BLOCK
                if layer == 0:
                    _load(x, first * inputs, rows, inputs, given, stride)
                else:
                    kept -= count * depth
                    _load(hidden, kept + first * depth, rows, depth, given, stride)
                if learns:
                    to = mine + starts[layer]
                    product(given, 0, 1, stride, depth, g, 0, width, sums, to, width, sums, to, width, rows, _LEAST)
                    to = mine + shifts[layer]
                    for r in range(rows):
                        for c in range(0, width, WIDE):
                            add_lanes(sums, to + c, g, r * width + c, sums, to + c)
                    if layer == 0 and across > 0:
                        wide = (across + BLOCK - 1) // BLOCK * BLOCK
                        for r in range(rows):
                            _row(shared, row[first + r] * across, across, given, r * wide, wide)
                        to = mine + starts[layers]
                        product(given, 0, 1, wide, across, g, 0, width, sums, to, width, sums, to, width, rows, _LEAST)
                if layer == 0 and len(out) == 0:
                    continue
                w_at -= width * padded
                product(g, 0, width, 1, BLOCK, transposed, w_at, padded, none, 0, 0, behind, 0, padded, width, _LEAST)
                if layer == 0:
                    for r in range(rows):
                        _row(behind, r * padded, inputs, out, (first + r) * inputs, inputs)
                else:
                    for r in range(BLOCK):
                        for c in range(0, depth, WIDE):
                            mask_lanes(behind, r * padded + c, given, r * stride + c, g, r * depth + c)
