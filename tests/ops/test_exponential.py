"""Vector exponentials against fp64: relative bounds over the whole range, and where it ends."""

import numba
import numpy as np
import pytest

from fprf.ops.lanes import WIDE, exp_lanes, opaque_lanes

U = 2.0**-24
"""Unit round-off of float32."""
NAN, INF = float("nan"), float("inf")


@numba.njit
def _run(kind: int, x: np.ndarray, out: np.ndarray) -> None:
    for i in range(0, len(x), WIDE):
        if kind == 0:
            exp_lanes(x, i, out, i)
        else:
            opaque_lanes(x, i, out, i)


def run(kind: int, x: np.ndarray) -> np.ndarray:
    padded = np.zeros(-(-len(x) // WIDE) * WIDE, np.float32)
    padded[: len(x)] = x
    out = np.empty_like(padded)
    _run(kind, padded, out)
    return out[: len(x)].astype(np.float64)


def grid(low: float, high: float) -> np.ndarray:
    """Evenly, and down to where nothing is left of a number."""
    even = np.linspace(low, high, 300_001)
    tiny = np.geomspace(1e-38, max(-low, high), 100_001)
    both = np.concatenate([even, tiny[tiny <= high], -tiny[-tiny >= low]])
    return both.astype(np.float32)


def test_exp_is_within_three_units() -> None:
    x = grid(-87.3, 88.2)
    exact = np.exp(x.astype(np.float64))
    assert (np.abs(run(0, x) - exact) <= 3 * U * exact).all()


def test_opacity_is_within_three_units_however_thin() -> None:
    x = np.abs(grid(0.0, 100.0))
    exact = -np.expm1(-x.astype(np.float64))
    assert (np.abs(run(1, x) - exact) <= 3 * U * exact).all()


@pytest.mark.parametrize(
    ("kind", "x", "value"),
    [
        (0, 0.0, 1.0),
        (0, -0.0, 1.0),
        (0, -88.0, 0.0),
        (0, -INF, 0.0),
        (0, 89.0, INF),
        (0, INF, INF),
        (0, NAN, NAN),
        (1, 0.0, 0.0),
        (1, 1e30, 1.0),
        (1, INF, 1.0),
        (1, NAN, NAN),
    ],
)
def test_ends_of_the_range(kind: int, x: float, value: float) -> None:
    (found,) = run(kind, np.array([x], np.float32))
    assert found == value or (np.isnan(found) and np.isnan(value))
