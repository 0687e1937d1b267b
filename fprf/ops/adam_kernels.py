"""The compiled loops behind `adam`. Arrays are flat, contiguous float32 of whole vectors."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .simd import WIDE, load, narrow, repeat, splat, square_root, store, total, traced
from .threads import cached_jit

_jit = cached_jit(parallel=True, nogil=True)
_TASK = 2**14
"""Numbers that a thread takes at a time: 64 KiB of each array; by eye."""
_PIECE = 2**10
"""Squares that are added in float32, 64 a lane, before float64 takes them."""


@traced
def moved(arrays, numbers, at, count):
    """Step `count` numbers from `at` on, and clear their gradient; the arguments as of `step`."""
    parameter, gradient, first, second = arrays
    keep, add, keep_square, add_square, rate, unbias, eps = (narrow(number, WIDE) for number in numbers)

    def step(k, held):
        x = at + k
        g = load(gradient, x, WIDE)
        mean = load(first, x, WIDE) * keep + g * add
        square = load(second, x, WIDE) * keep_square + g * g * add_square
        store(first, x, mean)
        store(second, x, square)
        store(parameter, x, load(parameter, x, WIDE) - rate * mean / (square_root(square) * unbias + eps))
        store(gradient, x, splat(gradient, 0.0, WIDE))
        return held

    repeat(count, [splat(parameter, 0.0, WIDE)], step, by=WIDE)


@_jit
def step(parameter, gradient, first, second, numbers):
    """One step of all, and the gradient cleared.

    `numbers` are beta1, 1 - beta1, beta2, 1 - beta2, the rate over what the weights of the first moment sum to,
    one over the root of the same of the second, and eps.
    """
    size = len(parameter)
    given = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5], numbers[6])
    for task in numba.prange((size + _TASK - 1) // _TASK):
        at = task * _TASK
        moved((parameter, gradient, first, second), given, at, min(_TASK, size - at))


@traced
def squares(x, at, count):
    """The sum of the squares of `count` numbers, whole vectors."""

    def add(k, sums):
        value = load(x, at + k, WIDE)
        return [sums[0] + value * value]

    (found,) = repeat(count, [splat(x, 0.0, WIDE)], add, by=WIDE)
    return total(found)


@numba.njit(inline="always")
def _piecewise(x, first, count):
    """`squares` of any length, its pieces added in float64."""
    found = 0.0
    for at in range(0, count, _PIECE):
        found += squares(x, first + at, min(_PIECE, count - at))
    return found


@_jit
def square_sum(x):
    """Sum of the squares of any length."""
    whole = len(x) // WIDE * WIDE
    found = 0.0
    for task in numba.prange((whole + _TASK - 1) // _TASK):
        at = task * _TASK
        found += _piecewise(x, at, min(_TASK, whole - at))
    for at in range(whole, len(x)):
        found += np.float64(x[at]) * np.float64(x[at])
    return found
