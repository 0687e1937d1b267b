"""Fields and what they are made of: contracts, what moves what, density, networks, planes, harmonics."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.fields.config import PlanesConfig
from fprf.fields.planes import MAX_LOG_DENSITY, PlanesField, density
from fprf.ops.harmonics import spherical_harmonics as harmonics

SMALL = PlanesConfig(resolutions=(4, 9), channels=8, hidden=16)


def cloud(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    view = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1)
    return torch.empty(count, 3).uniform_(-1, 1, generator=draw), view


def test_direction_changes_content_unless_there_is_none() -> None:
    points, view = cloud(20)
    for degree, changes in ((1, False), (2, True), (4, True)):
        field = PlanesConfig(resolutions=(4,), channels=8, hidden=16, degree=degree).build(channels=5, seed=0)
        latent = field.density(points).latent
        assert torch.equal(field.content(latent, view), field.content(latent, -view)) != changes


def test_density_does_not_meet_the_network() -> None:
    field = SMALL.build(channels=6, seed=0)
    assert isinstance(field, PlanesField)
    field.density(cloud(30)[0]).density.sum().backward()
    assert all(p.grad is None for p in field.to_content.parameters()) and field.offset.grad is None
    assert field.planes.table.grad is not None and field.to_density.weight.grad is not None


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
    wanted = math.exp(max(raw - 1, -MAX_LOG_DENSITY))
    assert abs(gradient.item() - wanted) <= (slack + 4 * U) * wanted


@pytest.mark.parametrize("raw", [-3e38, -1e4, -200.0, 16.0, 90.0, 1e4, 3e38, math.inf, -math.inf])
def test_extremes_are_finite(raw: float) -> None:
    x = torch.tensor([raw], requires_grad=True)
    value = density(x)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert 0 <= value.item() <= math.exp(MAX_LOG_DENSITY) * 1.00001
    # A dense point can become thin again, and empty space can fill: the gradient dies at neither end.
    assert math.exp(-MAX_LOG_DENSITY) * 0.9999 <= gradient.item() <= math.exp(MAX_LOG_DENSITY) * 1.00001


def quadrature() -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials up to degree 15 over the sphere exactly, float64."""
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * math.pi * (np.arange(16) + 0.5) / 16
    radius = np.sqrt(1 - z * z)
    x = radius[:, None] * np.cos(angle)
    y = radius[:, None] * np.sin(angle)
    view = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3)
    return torch.from_numpy(view), torch.from_numpy(np.repeat(weight, 16) * 2 * math.pi / 16)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_they_are_orthonormal(degree: int) -> None:
    view, weight = quadrature()
    values = harmonics(view, degree)
    assert values.shape == (len(view), degree * degree)
    gram = (values * weight[:, None]).T @ values
    assert (gram - torch.eye(degree * degree, dtype=torch.float64)).abs().max() <= 1e-12
