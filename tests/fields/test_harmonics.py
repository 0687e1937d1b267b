"""Spherical harmonics: orthonormal, closed under rotation, and Legendre's along z."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from fprf.errors import ConfigError
from fprf.fields.planes import MAX_DEGREE, count, harmonics


def quadrature() -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials up to degree 15 over the sphere exactly, float64."""
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * math.pi * (np.arange(16) + 0.5) / 16
    radius = np.sqrt(1 - z * z)
    x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    view = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], -1).reshape(-1, 3)
    return torch.from_numpy(view), torch.from_numpy(np.repeat(weight, 16) * 2 * math.pi / 16)


@pytest.mark.parametrize("degree", range(1, MAX_DEGREE + 1))
def test_they_are_orthonormal(degree: int) -> None:
    view, weight = quadrature()
    values = harmonics(view, degree)
    assert values.shape == (len(view), degree * degree) and count(degree) == degree * degree
    gram = (values * weight[:, None]).T @ values
    assert (gram - torch.eye(degree * degree, dtype=torch.float64)).abs().max() <= 1e-12


@pytest.mark.parametrize("degree", range(1, MAX_DEGREE + 1))
def test_each_band_turns_into_itself(degree: int) -> None:
    """The values of a rotated direction are an orthogonal map of those of the direction, band by band."""
    view, weight = quadrature()
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(degree)))
    before, after = harmonics(view, degree), harmonics(view @ turn.T, degree)
    mixing = (after * weight[:, None]).T @ before
    assert (before @ mixing.T - after).abs().max() <= 1e-12
    for band in range(degree):
        inside = slice(band * band, (band + 1) ** 2)
        outside = mixing[inside].clone()
        outside[:, inside] = 0
        assert outside.abs().max() <= 1e-12


def test_the_addition_theorem() -> None:
    """Sum over a band of Y(a) Y(b) = (2l + 1) / 4 pi times Legendre's polynomial of a . b."""
    draw = torch.Generator().manual_seed(0)
    a, b = (torch.nn.functional.normalize(torch.randn(40, 3, dtype=torch.float64, generator=draw), dim=-1) for _ in range(2))
    one, two, cosine = harmonics(a, 4), harmonics(b, 4), (a * b).sum(-1).numpy()
    for band in range(4):
        inside = slice(band * band, (band + 1) ** 2)
        legendre = np.polynomial.legendre.Legendre.basis(band)(cosine) * (2 * band + 1) / (4 * math.pi)
        assert ((one[:, inside] * two[:, inside]).sum(-1) - torch.from_numpy(legendre)).abs().max() <= 1e-12


def test_lower_degrees_are_a_prefix() -> None:
    view = torch.nn.functional.normalize(torch.randn(10, 3), dim=-1)
    for degree in range(1, MAX_DEGREE):
        assert torch.equal(harmonics(view, degree), harmonics(view, MAX_DEGREE)[:, : degree * degree])
    assert harmonics(view[:0], 3).shape == (0, 9) and harmonics(view, 2).dtype == torch.float32


@pytest.mark.parametrize("degree", [-1, 0, 5])
def test_other_degrees_are_refused(degree: int) -> None:
    with pytest.raises(ConfigError, match=rf"degree: {degree} must lie in \[1, 4\]"):
        count(degree)
