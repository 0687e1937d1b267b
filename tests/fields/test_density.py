"""Density: exp with a cap, against fp64, and a gradient that is finite for every float."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.fields.planes import LIMIT, density

U = 2.0**-24


@settings(max_examples=60, deadline=None)
@given(st.floats(-80, 15, width=32))
def test_it_is_exp_below_the_cap(raw: float) -> None:
    x = torch.tensor([raw], requires_grad=True)
    value = density(x)
    # raw - 1 rounds by u of itself, which exp makes a relative error; exp itself is good to 2u.
    exact = math.exp(raw - 1)
    slack = U * (abs(raw - 1) + 4)
    assert abs(value.item() - exact) <= slack * exact + 1e-38
    (gradient,) = torch.autograd.grad(value.sum(), x)
    wanted = math.exp(max(raw - 1, -LIMIT))
    assert abs(gradient.item() - wanted) <= (slack + 4 * U) * wanted


@pytest.mark.parametrize("raw", [-3e38, -1e4, -200.0, 16.0, 90.0, 1e4, 3e38, math.inf, -math.inf])
def test_extremes_are_finite(raw: float) -> None:
    x = torch.tensor([raw], requires_grad=True)
    value = density(x)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert 0 <= value.item() <= math.exp(LIMIT) * 1.00001
    # A dense point can become thin again, and empty space can fill: the gradient dies at neither end.
    assert math.exp(-LIMIT) * 0.9999 <= gradient.item() <= math.exp(LIMIT) * 1.00001


def test_what_is_not_a_number_is_not_hidden() -> None:
    assert density(torch.tensor([math.nan])).isnan().all()
