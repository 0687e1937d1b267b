"""LPIPS: the numbers of the authors' package, and what holds for any pair of images."""

import math

import pytest
import torch
from torch import Tensor

from fprf.errors import DataError, NumericsError
from fprf.evaluation.lpips import WEIGHTS, lpips


def picture(height: int, width: int, phase: float) -> Tensor:
    """Smooth waves of colour and a disc [H W 3]."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    waves = (
        torch.stack([torch.sin(9 * x + phase), torch.sin(7 * y - phase), torch.cos(5 * (x + y) * (1 + phase))], -1) / 2 + 0.5
    )
    disc = ((x - 0.6) ** 2 + (y - 0.4) ** 2 < 0.05)[..., None]
    return torch.where(disc, 1 - waves, waves)


def noisy(image: Tensor) -> Tensor:
    steps = torch.arange(image.numel(), dtype=torch.float64)
    return (image + 0.3 * torch.frac(torch.sin(steps * 12.9898) * 43758.5453).reshape(image.shape).float()).clamp(0, 1)


STORED = {
    "other colours": (picture(64, 96, 0.0), picture(64, 96, 0.5), 0.266698),
    "nearly the same": (picture(127, 90, 0.0), picture(127, 90, 0.1), 0.031176),
    "noise": (picture(100, 100, 0.2), noisy(picture(100, 100, 0.2)), 0.494266),
    "grey": (picture(64, 64, 0.0), torch.full((64, 64, 3), 0.5), 0.945153),
}
"""Two images and what `lpips` 0.1.4 of PyPI said: net alex, version 0.1, its own heads."""


@pytest.mark.parametrize("name", STORED)
def test_numbers_are_those_of_the_authors_package(name: str) -> None:
    a, b, expected = STORED[name]
    assert lpips(a, b) == pytest.approx(expected, abs=1e-3)
    assert lpips(b, a) == pytest.approx(lpips(a, b), rel=1e-5)
    assert lpips(a, a) == 0


def test_only_what_counts_is_judged() -> None:
    a = picture(96, 96, 0.0)
    b, where = a.clone(), torch.zeros(96, 96, dtype=torch.bool)
    b[:, :30] = 0
    where[:, 64:] = True
    assert lpips(a, b, ~where) > 0.1 > 10 * lpips(a, b, where)
    assert lpips(a, b, torch.ones_like(where)) == pytest.approx(lpips(a, b), rel=1e-6)


@pytest.mark.parametrize("size", [(1, 1), (12, 48), (30, 31)])
def test_small_images_are_judged_too(size: tuple[int, int]) -> None:
    assert 0 < lpips(torch.zeros(*size, 3), torch.ones(*size, 3)) < 2


def test_images_that_cannot_be_compared_are_refused() -> None:
    with pytest.raises(DataError, match="one size"):
        lpips(torch.zeros(32, 32, 3), torch.zeros(32, 33, 3))
    with pytest.raises(NumericsError):
        lpips(torch.full((32, 32, 3), math.nan), torch.zeros(32, 32, 3))


def test_the_weights_are_small() -> None:
    assert WEIGHTS.stat().st_size < 5e6
