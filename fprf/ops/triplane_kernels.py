"""The compiled loops behind `triplane_numba`. Conventions are those of `triplane`; arrays are flat, contiguous float32."""

# numba passes the typing context of an intrinsic by itself, which the checker cannot know: call-arg.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .vector import LANES, product_backward, product_forward

__all__ = ["GROUP", "backward", "forward", "variation", "variation_gradient"]

GROUP = 16
"""Channels of one backward task: a cache line of float32."""

_jit = numba.njit(parallel=True, cache=True, nogil=True)
# Differences of neighbours may be summed in any order inside a row: the sum is a regulariser, kept in float64.
_jit_sum = numba.njit(parallel=True, cache=True, nogil=True, fastmath={"contract", "reassoc"})


@numba.njit(inline="always", cache=True)
def _cell(x, size):
    """Node at or below a coordinate in [-1, 1], and the share of the next one; outside counts as the border.

    The comparison is written so that NaN falls on the lower border: an index must never leave the table.
    """
    last = np.float32(size - 1)
    at = (x + np.float32(1)) * (np.float32(0.5) * last)
    at = min(at, last) if at > np.float32(0) else np.float32(0)
    low = min(int(at), size - 2)
    return low, at - np.float32(low)


@_jit
def forward(points, table, channels, sizes, starts, out):
    """out[n, scale, c] = product over the planes of the bilinear sample at point n."""
    scales = len(sizes)
    for n in numba.prange(len(points)):
        for scale in range(scales):
            size = sizes[scale]
            i, u = _cell(points[n, 0], size)
            j, v = _cell(points[n, 1], size)
            k, w = _cell(points[n, 2], size)
            a = (starts[scale] + j * size + i) * channels
            b = (starts[scale] + size * size + k * size + i) * channels
            c = (starts[scale] + 2 * size * size + k * size + j) * channels
            o = (n * scales + scale) * channels
            for s in range(0, channels, LANES):
                product_forward(table, out, a + s, b + s, c + s, o + s, channels, size * channels, u, v, w)


@_jit
def backward(points, table, channels, sizes, starts, grad, out):
    """Add the table's gradient to `out`; one task a scale and group of channels, finest scales first."""
    scales = len(sizes)
    groups = (channels + GROUP - 1) // GROUP
    for task in numba.prange(scales * groups):
        scale, first = scales - 1 - task // groups, task % groups * GROUP
        last = min(first + GROUP, channels)
        size = sizes[scale]
        for n in range(len(points)):
            i, u = _cell(points[n, 0], size)
            j, v = _cell(points[n, 1], size)
            k, w = _cell(points[n, 2], size)
            a = (starts[scale] + j * size + i) * channels
            b = (starts[scale] + size * size + k * size + i) * channels
            c = (starts[scale] + 2 * size * size + k * size + j) * channels
            o = (n * scales + scale) * channels
            for s in range(first, last, LANES):
                product_backward(table, grad, out, a + s, b + s, c + s, o + s, channels, size * channels, u, v, w)


@_jit_sum
def variation(table, channels, sizes, starts):
    """Sum over scales of the mean squared difference of neighbours across, and down."""
    total = 0.0
    for scale in range(len(sizes)):
        size = sizes[scale]
        part = 0.0
        for row in numba.prange(3 * size):
            first, width = (starts[scale] + row * size) * channels, size * channels
            line = 0.0
            for x in range(first, first + width - channels):
                across = table[x + channels] - table[x]
                line += across * across
            if row % size < size - 1:
                for x in range(first, first + width):
                    down = table[x + width] - table[x]
                    line += down * down
            part += line
        total += part / (3.0 * size * (size - 1) * channels)
    return total


@_jit
def variation_gradient(table, channels, sizes, starts, scale, out):
    """out = scale * d variation / d table: twice the differences to the four neighbours; a missing one is itself."""
    for s in range(len(sizes)):
        size = sizes[s]
        factor = np.float32(2.0 * scale / (3.0 * size * (size - 1) * channels))
        width = size * channels
        for row in numba.prange(3 * size):
            v, first = row % size, (starts[s] + row * size) * channels
            north = width if v > 0 else 0
            south = width if v < size - 1 else 0
            for u in range(size):
                west = channels if u > 0 else 0
                east = channels if u < size - 1 else 0
                for x in range(first + u * channels, first + (u + 1) * channels):
                    near = table[x - west] + table[x + east] + table[x - north] + table[x + south]
                    out[x] = factor * (np.float32(4) * table[x] - near)
