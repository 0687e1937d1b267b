"""Tri-plane lookup: the fused and the plain form against fp64 loops, at the documented bound, at production sizes."""

import itertools
from collections.abc import Sequence

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.ops import triplane_numba
from fprf.ops.triplane import AXES, lookup, lookup_reference, rows, split, variation

QUICK = settings(max_examples=20, deadline=None)
U = 2.0**-24
"""Unit round-off of float32."""


def table_of(resolutions: Sequence[int], channels: int, seed: int = 0, smooth: bool = False) -> Tensor:
    draw = torch.Generator().manual_seed(seed)
    low, high = (0.999, 1.001) if smooth else (-1.0, 1.0)
    return torch.empty(rows(resolutions), channels).uniform_(low, high, generator=draw)


def points_of(count: int, seed: int = 0) -> Tensor:
    return torch.empty(count, 3).uniform_(-1, 1, generator=torch.Generator().manual_seed(seed))


def nodes(x: float, size: int) -> float:
    """Where a coordinate falls between the nodes, in float64."""
    return min(max((float(x) + 1) * 0.5 * (size - 1), 0.0), size - 1.0)


def sample(plane: np.ndarray, u: float, v: float, size_only: bool) -> np.ndarray:
    """Bilinear, float64, written out; of magnitudes where only sizes matter."""
    size = len(plane)
    i, j = min(int(u), size - 2), min(int(v), size - 2)
    total = np.zeros(plane.shape[-1])
    for down, across in itertools.product((0, 1), (0, 1)):
        share = ((v - j) if down else 1 - (v - j)) * ((u - i) if across else 1 - (u - i))
        node = plane[j + down, i + across].astype(np.float64)
        total += share * (np.abs(node) if size_only else node)
    return total


def product(grid: np.ndarray, at: Sequence[float], size_only: bool = False) -> np.ndarray:
    value = np.ones(grid.shape[-1])
    for plane, (a, b) in zip(grid, AXES, strict=True):
        value = value * sample(plane, at[a], at[b], size_only)
    return value


def oracle(points: Tensor, table: Tensor, resolutions: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Values, and the bound 4u (r |slope| + 3 |value|): what 4u r nodes along each axis change, and magnitudes' rounding."""
    values, bounds = [], []
    grids = [g.numpy() for g in split(table, resolutions)]
    for p in points:
        value, bound = [], []
        for grid, r in zip(grids, resolutions, strict=True):
            at = [nodes(x, r) for x in p]
            here = product(grid, at)
            moved = np.zeros_like(here)
            for axis, way in itertools.product(range(3), (4 * U * r, 2 * U * r)):
                change = np.zeros_like(here)
                for sign in (-1, 1):
                    there = list(at)
                    there[axis] = min(max(at[axis] + sign * way, 0.0), r - 1.0)
                    change = np.maximum(change, np.abs(product(grid, there) - here))
                moved += change
            value.append(here)
            bound.append(moved + 12 * U * product(grid, at, size_only=True))
        values.append(np.concatenate(value))
        bounds.append(np.concatenate(bound))
    return torch.from_numpy(np.array(values)), torch.from_numpy(np.array(bounds))


@pytest.mark.parametrize(
    ("resolutions", "channels"), [((64, 181), 8), ((182,), 16), ((5, 33, 2), 24), ((1024,), 8), ((7, 182), 5)]
)
@pytest.mark.parametrize("smooth", [False, True])
def test_both_forms_stay_within_the_bound(resolutions: tuple[int, ...], channels: int, smooth: bool) -> None:
    table, points = table_of(resolutions, channels, smooth=smooth), points_of(30)
    assert triplane_numba.usable(points, table) == (channels % 8 == 0)
    value, bound = oracle(points, table, resolutions)
    for form in (lookup, lookup_reference):
        found = form(points, table, resolutions)
        assert found.dtype == torch.float32 and found.shape == (30, len(resolutions) * channels)
        assert ((found.double() - value).abs() <= bound).all()


@QUICK
@given(
    st.lists(st.floats(-1, 1, width=32), min_size=3, max_size=3),
    st.lists(st.integers(2, 20), min_size=1, max_size=3),
    st.sampled_from([5, 8, 16]),
    st.integers(0, 99),
)
def test_any_point_of_any_planes(point: list[float], resolutions: list[int], channels: int, seed: int) -> None:
    table, points = table_of(resolutions, channels, seed), torch.tensor([point])
    value, bound = oracle(points, table, resolutions)
    assert ((lookup(points, table, resolutions).double() - value).abs() <= bound + 1e-30).all()


def test_nodes_and_shared_borders_are_met_exactly() -> None:
    """At a node the sample is the node; two blocks that share an edge agree on it."""
    table = table_of((5,), 8)
    grid = split(table, (5,))[0]
    at = torch.tensor(list(itertools.product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=3)))
    i = ((at + 1) * 2).long()
    exact = grid[0][i[:, 1], i[:, 0]] * grid[1][i[:, 2], i[:, 0]] * grid[2][i[:, 2], i[:, 1]]
    assert torch.equal(lookup(at, table, (5,)), exact)
    assert torch.equal(lookup_reference(at, table, (5,)), exact)


WILD = (float("nan"), float("inf"), -float("inf"), 1e30, -1e30, 1.0 + 2e-7, -1.0 - 2e-7, 1.0, -1.0, 0.3)


@pytest.mark.parametrize("channels", [5, 8, 16])
@pytest.mark.parametrize("size", [2, 3, 182])
def test_no_coordinate_leaves_the_table(channels: int, size: int) -> None:
    """The table lies between sentinels: forward never reads them, backward never writes them. NaN is the lower border."""
    points = torch.tensor(list(itertools.product(WILD, repeat=3)))
    total = rows((size,))
    padded = torch.full((total + 2 * size * size, channels), float("nan"))
    table = padded[size * size : size * size + total]
    table.copy_(table_of((size,), channels))
    table.requires_grad_(True)
    tame = points.nan_to_num(nan=-1.0).clamp(-1, 1)
    for form in (lookup, lookup_reference):
        found = form(points, table, (size,))
        assert found.isfinite().all()
        assert torch.equal(found, form(tame, table, (size,)))
        (gradient,) = torch.autograd.grad(found.sum(), table)
        assert gradient.shape == table.shape and gradient.isfinite().all()
    assert padded[: size * size].isnan().all() and padded[size * size + total :].isnan().all()


@pytest.mark.parametrize("count", [0, 1, 7, 1025])
@pytest.mark.parametrize("channels", [5, 8, 24])
def test_any_number_of_points(count: int, channels: int) -> None:
    resolutions = (4, 9)
    table = table_of(resolutions, channels).requires_grad_(True)
    points = points_of(count)
    found = lookup(points, table, resolutions)
    assert found.shape == (count, 2 * channels)
    assert torch.allclose(found, lookup_reference(points, table, resolutions), atol=2e-6)
    (gradient,) = torch.autograd.grad(found.sum(), table)
    assert torch.allclose(
        gradient, torch.autograd.grad(lookup_reference(points, table, resolutions).sum(), table)[0], atol=1e-4
    )
    if count == 0:
        assert not gradient.any()


@QUICK
@given(st.integers(1, 12), st.integers(0, 99))
def test_each_point_stands_alone(count: int, seed: int) -> None:
    """A point's features are bitwise the same in any batch and from any memory layout; order carries over."""
    resolutions = (3, 17)
    table, points = table_of(resolutions, 16, seed), points_of(count, seed)
    whole = lookup(points, table, resolutions)
    assert torch.equal(torch.cat([lookup(p[None], table, resolutions) for p in points]), whole)
    assert torch.equal(lookup(points.flip(0), table, resolutions).flip(0), whole)
    assert torch.equal(lookup(points.T.contiguous().T, table.T.contiguous().T, resolutions), whole)


def test_scales_lie_side_by_side() -> None:
    resolutions = (4, 9, 6)
    table, points = table_of(resolutions, 8), points_of(50)
    starts = np.cumsum([0, *(3 * r * r for r in resolutions)])
    parts = [lookup(points, table[a:b].clone(), (r,)) for a, b, r in zip(starts[:-1], starts[1:], resolutions, strict=True)]
    assert torch.equal(lookup(points, table, resolutions), torch.cat(parts, -1))
    assert [tuple(s.shape) for s in split(table, resolutions)] == [(3, r, r, 8) for r in resolutions]


@pytest.mark.parametrize(("resolutions", "channels", "count"), [((64, 182), 16, 5000), ((16,), 24, 777), ((1024,), 8, 3000)])
def test_gradients_are_those_of_fp64(resolutions: tuple[int, ...], channels: int, count: int) -> None:
    """As gsplat compares them: relative L2, cosine, signed bias; nothing at nodes that no point touches.

    Coordinates are multiples of 1/256, which fall exactly between the nodes: their rounding (2u r nodes) is forward's bound.
    """
    points = (points_of(count) * 256).round() / 256
    table = table_of(resolutions, channels).requires_grad_(True)
    weight = torch.randn(count, len(resolutions) * channels, generator=torch.Generator().manual_seed(5))
    found = torch.autograd.grad((lookup(points, table, resolutions) * weight).sum(), table)[0]
    exact_table = table.detach().double().requires_grad_(True)
    value = lookup_reference(points.double(), exact_table, resolutions)
    exact = torch.autograd.grad((value * weight).sum(), exact_table)[0]
    error = found.double() - exact
    assert error.norm() <= 1e-5 * exact.norm()
    assert (found.double() * exact).sum() / (found.double().norm() * exact.norm()) >= 1 - 1e-9
    assert error.sum().abs() <= 1e-6 * exact.abs().sum()
    assert not found[exact == 0].any()


@pytest.mark.parametrize("resolutions", [(2,), (3, 5)])
def test_the_plain_form_differentiates(resolutions: tuple[int, ...]) -> None:
    table = table_of(resolutions, 2).double().requires_grad_(True)
    points = points_of(6).double()
    assert torch.autograd.gradcheck(lambda t: lookup(points, t, resolutions), (table,))
    assert torch.autograd.gradcheck(lambda t: variation(t, resolutions), (table,))


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only: nothing to compare")
def test_one_thread_and_two_give_the_same_bits() -> None:
    resolutions = (16, 64, 182)
    table, points = table_of(resolutions, 24).requires_grad_(True), points_of(4001)
    results = []
    for count in (1, 2, 2):
        numba.set_num_threads(count)
        found = lookup(points, table, resolutions)
        (gradient,) = torch.autograd.grad(found.square().sum(), table)
        results.append((found, gradient))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
