"""Mixtures of styles at points: compiled forms against fp64 at their bounds."""

import numba
import pytest
import torch
from plain_forms import plainly
from torch import Tensor

from fprf.ops.mixture import affine, scaled
from fprf.ops.simd import BLOCK

U = 2.0**-24
"""Unit round-off of float32."""


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def shares(count: int, regions: int, seed: int = 0) -> Tensor:
    """Rows that sum to 1, most entries 0."""
    odds = (draw(count, regions, seed=seed) * 4).exp()
    odds = torch.where(odds < 0.1 * odds.amax(1, keepdim=True), 0.0, odds)
    return odds / odds.sum(1, keepdim=True)


def affine_oracle(x: Tensor, share: Tensor, matrix: Tensor, bias: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
    away, a = (x.double() - centre.double()), share.double()
    value = torch.einsum("nk,nc,kcd->nd", a, away, matrix.double()) + a @ bias.double()
    # Subtracting the centre errs by u of the difference, which the products carry on.
    size = torch.einsum("nk,nc,kcd->nd", a, away.abs(), matrix.double().abs()) + a @ bias.double().abs()
    return value, (x.shape[1] + share.shape[1] + 4) * U * size


@torch.no_grad()
@pytest.mark.parametrize(("channels", "regions"), [(48, 8), (128, 3), (5, 4), (16, 1), (33, 20)])
@pytest.mark.parametrize("count", [1, 3 * BLOCK + 5])
def test_affine_maps_stay_within_the_bound(channels: int, regions: int, count: int) -> None:
    x, centre = draw(count, channels) + 3, draw(channels, seed=1) + 3
    matrix, bias, share = draw(regions, channels, channels, seed=2), draw(regions, channels, seed=3), shares(count, regions)
    value, bound = affine_oracle(x, share, matrix, bias, centre)
    for form in (affine, plainly(affine)):
        found = form(x, share, matrix, bias, centre=centre)
        assert found.shape == x.shape and ((found.double() - value).abs() <= bound).all()


@torch.no_grad()
@pytest.mark.parametrize(("channels", "regions"), [(48, 8), (5, 4), (16, 1)])
@pytest.mark.parametrize("count", [1, 3 * BLOCK + 5])
def test_gains_and_biases_stay_within_the_bound(channels: int, regions: int, count: int) -> None:
    x, centre, share = draw(count, channels) + 3, draw(channels, seed=1) + 3, shares(count, regions)
    gain, bias = draw(regions, channels, seed=2), draw(regions, channels, seed=3)
    away, a = x.double() - centre.double(), share.double()
    value = away * (a @ gain.double()) + a @ bias.double()
    bound = (regions + 4) * U * (away.abs() * (a @ gain.double().abs()) + a @ bias.double().abs())
    for form in (scaled, plainly(scaled)):
        found = form(x, share, gain, bias, centre=centre)
        assert found.shape == x.shape and ((found.double() - value).abs() <= bound).all()


@torch.no_grad()
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only: nothing to compare")
def test_one_thread_and_two_and_any_batch_give_the_same_bits() -> None:
    x, share = draw(2000, 48), shares(2000, 8)
    matrix, bias = draw(8, 48, 48), draw(8, 48)
    results = []
    for count in (1, 2):
        numba.set_num_threads(count)
        results.append(affine(x, share, matrix, bias, centre=bias[0]))
    assert torch.equal(*results)
    some = torch.cat([affine(x[a : a + 77], share[a : a + 77], matrix, bias, centre=bias[0]) for a in range(0, 2000, 77)])
    assert torch.equal(some, results[0])
