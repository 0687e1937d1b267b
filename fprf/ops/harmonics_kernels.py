"""The compiled loop behind `harmonics.recoloured`: one Gaussian after the other, nothing in between leaves the registers."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import math

import numba
import numpy as np

from .simd import NARROW, dot, scaled

_C0, _HALF, _TINY = np.float32(0.28209479177387814), np.float32(0.5), np.float32(1e-5)
_0 = np.float32(0)
_REACH = tuple(np.float32(math.sqrt((2 * degree + 1) / (4 * math.pi))) for degree in range(4))
_BLOCK = 512


@numba.njit(inline="always", cache=True)
def _may_be_cut(rows, at, count):
    """Whether some colour may be below 0 from somewhere."""
    cut = False
    for c in range(3):
        low = _HALF + _C0 * rows[at + c]
        degree = 1
        while degree * degree < count:
            square = _0
            for k in range(degree * degree, (degree + 1) * (degree + 1)):
                square += rows[at + 3 * k + c] * rows[at + 3 * k + c]
            low -= _REACH[degree] * np.sqrt(square)
            degree += 1
        cut |= low < _TINY
    return cut


@numba.njit(inline="always", cache=True)
def _cut(rows, at, count, values, fit, size, colour, drawn):
    """Fit what is drawn again, in `drawn`, where some colour is cut; `colour` [3 size] is overwritten."""
    least = _0
    for c in range(3):
        for d in range(size):
            colour[c * size + d] = _HALF
        for k in range(count):
            factor = rows[at + 3 * k + c]
            for d in range(0, size, NARROW):
                scaled(values, k * size + d, factor, colour, c * size + d, colour, c * size + d)
        for d in range(size):
            least = min(least, colour[c * size + d])
            colour[c * size + d] = max(colour[c * size + d], _0) - _HALF
    if least < _0:
        for c in range(3):
            for k in range(count):
                drawn[3 * k + c] = dot(fit, k * size, colour, c * size, size)


@numba.njit(parallel=True, cache=True, nogil=True)
def recolour(rows, change, weight, values, fit, count, most, out):
    """out [N K 3] of rows [N K 3], change [N 4 3], weight [N], values and fit [count D], D whole vectors.

    `most` is the highest mean colour that is mapped to.
    """
    total, size = len(weight), len(values) // count
    run = len(rows) // total
    for task in numba.prange((total + _BLOCK - 1) // _BLOCK):
        colour, drawn = np.empty(3 * size, np.float32), np.empty(run, np.float32)
        for n in range(task * _BLOCK, min(total, (task + 1) * _BLOCK)):
            at, to = n * run, n * 12
            if not weight[n] > _0:
                for i in range(run):
                    out[at + i] = rows[at + i]
                continue
            for i in range(run):
                drawn[i] = rows[at + i]
            # As renderers draw it: where some colour is cut, fitted again.
            if _may_be_cut(rows, at, count):
                _cut(rows, at, count, values, fit, size, colour, drawn)
            # colour A + b, of every harmonic; then the mean colour, which has a limit.
            for k in range(0, run, 3):
                x, y, z = drawn[k], drawn[k + 1], drawn[k + 2]
                for c in range(3):
                    more = x * change[to + c] + y * change[to + 3 + c] + z * change[to + 6 + c]
                    out[at + k + c] = drawn[k + c] + more
            x, y, z = _HALF + _C0 * drawn[0], _HALF + _C0 * drawn[1], _HALF + _C0 * drawn[2]
            for c in range(3):
                mine = _HALF + _C0 * drawn[c]
                moved = mine + (x * change[to + c] + y * change[to + 3 + c] + z * change[to + 6 + c]) + change[to + 9 + c]
                moved = min(moved, max(mine, most))
                out[at + c] = (moved - _HALF) / _C0
