"""Total variation of tri-planes and its gradient, against loops in fp64."""

import itertools
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from fprf.ops.triplane import rows, split, variation, variation_reference

"""Unit round-off of float32."""


U = 2.0**-24


def table_of(resolutions: Sequence[int], channels: int) -> Tensor:
    return torch.empty(rows(resolutions), channels).uniform_(-1, 1, generator=torch.Generator().manual_seed(0))


def variation_oracle(table: Tensor, resolutions: Sequence[int]) -> float:
    """Loops over nodes."""
    total = 0.0
    for grid, r in zip(split(table, resolutions), resolutions, strict=True):
        g = grid.double().numpy()
        across = down = 0.0
        for plane, v, u in itertools.product(range(3), range(r), range(r)):
            if u + 1 < r:
                across += float(((g[plane, v, u + 1] - g[plane, v, u]) ** 2).sum())
            if v + 1 < r:
                down += float(((g[plane, v + 1, u] - g[plane, v, u]) ** 2).sum())
        total += (across + down) / (3 * r * (r - 1) * g.shape[-1])
    return total


@pytest.mark.parametrize(("resolutions", "channels"), [((2,), 8), ((5, 12), 16), ((3, 4), 5)])
def test_variation_is_the_sum_over_neighbours(resolutions: tuple[int, ...], channels: int) -> None:
    table = table_of(resolutions, channels)
    wanted = variation_oracle(table, resolutions)
    for form in (variation, variation_reference):
        assert abs(float(form(table, resolutions)) - wanted) <= 1e-6 * wanted


@pytest.mark.parametrize(("resolutions", "channels"), [((2, 3), 8), ((64, 182), 16)])
@pytest.mark.parametrize("scale", [1.0, -3.5, 0.0])
def test_gradient_of_variation(resolutions: tuple[int, ...], channels: int, scale: float) -> None:
    table = table_of(resolutions, channels).requires_grad_(True)
    exact_table = table.detach().double().requires_grad_(True)
    (found,) = torch.autograd.grad(variation(table, resolutions) * scale, table)
    (exact,) = torch.autograd.grad(variation_reference(exact_table, resolutions) * scale, exact_table)
    assert (found.double() - exact).norm() <= 1e-6 * exact.norm()
    # Opposite neighbours cancel: a constant shift of the planes costs nothing.
    assert abs(float(found.double().sum())) <= 1e-5 * float(found.double().abs().sum()) + 1e-30


def test_variation_of_a_constant_is_nothing() -> None:
    table = torch.full((rows((9,)), 8), 0.37, requires_grad=True)
    loss = variation(table, (9,))
    (gradient,) = torch.autograd.grad(loss, table)
    assert loss.item() == 0.0 and gradient.abs().max() <= 4 * U
