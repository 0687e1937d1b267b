"""Mixtures of styles at points: compiled forms against fp64 at their bounds."""

import numba
import pytest
import torch
from plain_forms import plainly
from torch import Tensor

from fprf.ops.mixture import affine, attention, scaled
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
def test_other_types_and_no_points_take_the_plain_form() -> None:
    x, share, centre = draw(7, 16).double(), shares(7, 3).double(), draw(16).double()
    matrix, bias = draw(3, 16, 16).double(), draw(3, 16).double()
    plain = plainly(affine)(x, share, matrix, bias, centre=centre), plainly(scaled)(x, share, bias, bias, centre=centre)
    fast = affine(x, share, matrix, bias, centre=centre), scaled(x, share, bias, bias, centre=centre)
    assert all(torch.equal(a, b) and a.dtype == torch.float64 for a, b in zip(plain, fast, strict=True))
    x, share, centre, matrix, bias = (each.float() for each in (x[:0], share[:0], centre, matrix, bias))
    assert affine(x, share, matrix, bias, centre=centre).shape == (0, 16)
    assert scaled(x, share, bias, bias, centre=centre).shape == (0, 16)


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


def attention_oracle(x: Tensor, keys: Tensor, temperature: float, centre: Tensor | None, prior: Tensor | None) -> Tensor:
    query = x.double() if centre is None else x.double() - centre.double()
    query = query if centre is None else query / query.norm(dim=1, keepdim=True)
    logits = query @ keys.double().T / temperature
    return torch.softmax(logits if prior is None else logits + prior.double().log(), 1)


@torch.no_grad()
@pytest.mark.parametrize(("depth", "count"), [(32, 8), (3, 1), (7, 20), (384, 17)])
@pytest.mark.parametrize("points", [1, 2 * BLOCK + 7])
@pytest.mark.parametrize("directed", [False, True])
def test_attention_is_the_softmax_of_the_scores(depth: int, count: int, points: int, directed: bool) -> None:
    """A score errs by (D + 4) u of its magnitudes, a share by twice that over the temperature."""
    x, keys, prior = draw(points, depth), draw(count, depth, seed=1) / depth**0.5, draw(count, seed=2).exp()
    centre = draw(depth, seed=3) * 0.1 if directed else None
    for temperature in (0.05, 0.4, 5.0):
        for weights in (None, prior):
            found = attention(x, keys, temperature, centre=centre, prior=weights)
            size = float((x.abs().double() @ keys.double().abs().T).max())
            wanted = attention_oracle(x, keys, temperature, centre, weights)
            assert ((found.double() - wanted).abs() <= 2 * (depth + 8) * U * size / temperature + 8 * U).all()
            assert ((found.double().sum(1) - 1).abs() <= (count + 4) * U).all()


@torch.no_grad()
def test_faint_shares_are_dropped_and_the_rest_sums_to_one() -> None:
    x, keys = draw(300, 16), draw(8, 16, seed=1)
    whole = attention(x, keys, 1.0)
    found = attention(x, keys, 1.0, faint=0.05)
    dropped = whole < 0.05 * whole.amax(1, keepdim=True) * (1 - 1e-5)
    kept = whole > 0.05 * whole.amax(1, keepdim=True) * (1 + 1e-5)
    assert dropped.any() and not found[dropped].any() and found[kept].all()
    assert torch.allclose(found.sum(1), torch.ones(300), atol=1e-6)


@torch.no_grad()
def test_a_point_at_the_centre_matches_everything_alike() -> None:
    keys, centre = draw(4, 16, seed=1), draw(16, seed=2)
    x = torch.stack([centre, centre * (1 + 1e-9), centre + 1])
    found = attention(x, keys, 0.1, centre=centre, flat=1e-6 * float(centre.norm()))
    assert torch.allclose(found[:2], torch.full((2, 4), 0.25))
    assert found[2].max() > 0.3
    close, far = (attention(torch.ones(1, 16) * step, keys, 0.1, centre=torch.zeros(16)) for step in (1e-3, 1.0))
    assert torch.allclose(close, far, atol=1e-5), "nothing is flat unless it is said"
    at_zero = attention(torch.zeros(1, 16), keys, 0.1, centre=torch.zeros(16))
    assert torch.allclose(at_zero, torch.full((1, 4), 0.25))


@torch.no_grad()
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only: nothing to compare")
def test_one_thread_and_two_and_any_batch_give_the_same_bits() -> None:
    x, share, keys = draw(2000, 48), shares(2000, 8), draw(8, 48, seed=1)
    matrix, bias = draw(8, 48, 48), draw(8, 48)
    results = []
    for count in (1, 2):
        numba.set_num_threads(count)
        results.append((affine(x, share, matrix, bias, centre=bias[0]), attention(x, keys, 1.0, faint=0.01)))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    some = torch.cat([affine(x[a : a + 77], share[a : a + 77], matrix, bias, centre=bias[0]) for a in range(0, 2000, 77)])
    assert torch.equal(some, results[0][0])
