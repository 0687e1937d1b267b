"""Gradients of tri-plane lookups in the points: kernels and plain form against differences in fp64, at a derived tolerance."""

from collections.abc import Sequence

import numba
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.ops import triplane_numba
from fprf.ops.triplane import lookup, lookup_reference, point_slopes_reference, rows

QUICK = settings(max_examples=20, deadline=None)
U = 2.0**-24
"""Unit round-off of float32."""


def table_of(resolutions: Sequence[int], channels: int, seed: int = 0) -> Tensor:
    return torch.empty(rows(resolutions), channels).uniform_(-1, 1, generator=torch.Generator().manual_seed(seed))


def points_of(count: int, resolution: int, seed: int = 0) -> Tensor:
    """Inside of cells, at a quarter, half or three quarters of them: exact in float32 where cells are a power of two."""
    draw = torch.Generator().manual_seed(seed)
    cell = torch.randint(resolution - 1, (count, 3), generator=draw)
    share = torch.randint(1, 4, (count, 3), generator=draw) / 4
    return (cell + share) * (2 / (resolution - 1)) - 1


def differences(points: Tensor, table: Tensor, resolutions: Sequence[int], grad: Tensor, step: float) -> Tensor:
    """Central differences in fp64: exact but for rounding, since a product of two linear factors is a parabola on each axis."""
    columns = []
    for axis in range(3):
        move = torch.zeros(3, dtype=torch.float64)
        move[axis] = step
        ahead, behind = (lookup_reference(points.double() + way * move, table.double(), resolutions) for way in (1, -1))
        columns.append(((ahead - behind) * grad).sum(-1) / (2 * step))
    return torch.stack(columns, -1)


def bound(points: Tensor, table: Tensor, resolutions: Sequence[int], grad: Tensor) -> Tensor:
    """What rounding may change. A slope is at most 4 + 4 times the product of magnitudes, at quarters of a cell; twenty
    operations lead to it, then come the sums over channels and scales.
    """
    channels = table.shape[1]
    sizes = lookup_reference(points.double(), table.double().abs(), resolutions) * grad.abs()
    parts = [0.5 * (r - 1) * part.sum(-1) for r, part in zip(resolutions, sizes.split(channels, -1), strict=True)]
    return U * (30 + channels / 8 + len(resolutions)) * 8 * torch.stack(parts).sum(0)[:, None]


@pytest.mark.parametrize(
    ("resolutions", "channels", "count"), [((9,), 8, 1), ((65,), 16, 500), ((17, 9), 24, 97), ((5, 3), 40, 0)]
)
def test_both_forms_are_the_differences(resolutions: tuple[int, ...], channels: int, count: int) -> None:
    points, table = points_of(count, resolutions[0]), table_of(resolutions, channels)
    grad = torch.randn(count, len(resolutions) * channels, generator=torch.Generator().manual_seed(3))
    exact = differences(points, table, resolutions, grad, 1 / 512)
    assert triplane_numba.usable(points, table)
    for found in (
        triplane_numba.point_slopes(points, table, resolutions, grad),
        point_slopes_reference(points, table, resolutions, grad),
    ):
        assert found.dtype == torch.float32 and found.shape == (count, 3)
        assert ((found - exact).abs() <= bound(points, table, resolutions, grad) + 1e-11).all()


@pytest.mark.parametrize("resolutions", [(2,), (3, 5)])
def test_the_plain_form_differentiates_in_points(resolutions: tuple[int, ...]) -> None:
    table = table_of(resolutions, 2).double()
    points = (0.37 * points_of(6, 9)).double().requires_grad_(True)
    assert torch.autograd.gradcheck(lambda p: lookup(p, table, resolutions), (points,))


@pytest.mark.parametrize("place", [1.5, -1.5, float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_outside_the_border_holds(place: float, axis: int) -> None:
    """No slope along the axis that a point has left, and those of the border along the others."""
    table, point = table_of((5,), 8), torch.tensor([[0.25, -0.375, 0.125]])
    point[0, axis] = place
    inside = point.clone()
    inside[0, axis] = 1.0 if place > 0 else -1.0
    grad = torch.randn(1, 8, generator=torch.Generator().manual_seed(2))
    wanted = point_slopes_reference(inside, table, (5,), grad)
    wanted[0, axis] = 0
    for form in (triplane_numba.point_slopes, point_slopes_reference):
        assert torch.allclose(form(point, table, (5,), grad), wanted, atol=1e-5)


@QUICK
@given(st.lists(st.floats(-1.25, 1.25, width=32), min_size=3, max_size=3), st.integers(2, 9), st.integers(0, 99))
def test_both_forms_agree_anywhere(point: list[float], size: int, seed: int) -> None:
    """On nodes too, where a sample has a kink: both take the cell above, and that before the last node."""
    table, points = table_of((size,), 16, seed), torch.tensor([point])
    grad = torch.ones(1, 16)
    ours, theirs = (
        triplane_numba.point_slopes(points, table, (size,), grad),
        point_slopes_reference(points, table, (size,), grad),
    )
    assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-4 * size)


def test_nothing_else_changes_where_points_ask() -> None:
    """Values and the other gradients are the same bits; without asking nothing is found for points."""
    results = []
    for asked in (False, True):
        points = points_of(700, 17).requires_grad_(asked)
        table, weight = table_of((17,), 8).requires_grad_(True), torch.full((8,), 0.3, requires_grad=True)
        value = lookup(points, table, (17,)) @ weight
        value.square().sum().backward()
        assert (points.grad is None) != asked
        results.append((value.detach(), table.grad, weight.grad))
    for a, b in zip(*results, strict=True):
        assert a is not None and b is not None and torch.equal(a, b)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only: nothing to compare")
def test_slopes_are_the_same_bits_with_any_threads() -> None:
    points, table = points_of(4001, 17), table_of((17, 9), 8)
    grad, results = torch.randn(4001, 16), []
    for count in (1, 2):
        numba.set_num_threads(count)
        results.append(triplane_numba.point_slopes(points, table, (17, 9), grad))
    assert torch.equal(*results)
