"""Mixtures of points: the compiled forms against float64 at derived bounds, and what becomes of NaN."""

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.ops import backend, mixture
from fprf.style.light import cosines, shown_units
from fprf.style.matching import no_direction, point_shares, unit
from fprf.style.scene_style import mixed_gains, mixed_maps

QUICK = settings(max_examples=20, deadline=None)
U = 2.0**-24
"""Unit round-off of float32."""
EXP2 = 4e-7
"""Relative error of the kernels' exponential, with the product before it."""


def draw(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def members(points: int, regions: int, seed: int) -> Tensor:
    """Shares of two or three regions a point."""
    share = torch.softmax(4 * draw(points, regions, seed=seed), 1)
    share = torch.where(share < 0.05 * share.amax(1, keepdim=True), 0.0, share)
    return share / share.sum(1, keepdim=True)


@QUICK
@given(st.integers(1, 70), st.integers(1, 40), st.integers(1, 120), st.integers(0, 99), st.booleans())
@example(32, 16, 49, 0, True)
@example(30, 17, 96, 1, False)
def test_shares_err_as_their_scores(depth: int, keys: int, points: int, seed: int, centred: bool) -> None:
    # Scores err by (D + 4) u |x| |key|, the softmax by twice that over the temperature (`point_shares`).
    temperature = 0.2
    x = draw(points, depth, seed=seed)
    centre = 0.3 * draw(depth, seed=seed + 1) if centred else None
    key = unit(draw(keys, depth, seed=seed + 2), torch.zeros(depth))
    prior = torch.rand(keys, generator=torch.Generator().manual_seed(seed)) + 0.1
    wide = None if centre is None else centre.double()
    truth = point_shares(x.double(), key.double(), temperature, centre=wide, prior=prior.double())
    with torch.no_grad():
        found = point_shares(x, key, temperature, centre=centre, prior=prior)
    length = torch.ones(points, 1) if centred else x.norm(dim=1, keepdim=True)
    bound = 4 * (depth + 4) * U * length.double() / temperature + EXP2
    assert found.dtype == torch.float32 and found.shape == truth.shape
    assert ((found.double() - truth).abs() <= bound).all()
    assert torch.allclose(found.sum(1), torch.ones(points), atol=1e-6)


def test_the_faintest_shares_are_nothing_and_the_rest_sums_to_one() -> None:
    x = draw(500, 32, seed=0)
    key = unit(draw(9, 32, seed=1), torch.zeros(32))
    with torch.no_grad():
        every = point_shares(x, key, 0.1)
        found = point_shares(x, key, 0.1, faint=0.01)
    clear = (every / every.amax(1, keepdim=True) - 0.01).abs() > 1e-5
    assert ((found == 0) == (every < 0.01 * every.amax(1, keepdim=True)))[clear].all()
    assert torch.allclose(found.sum(1), torch.ones(500), atol=1e-6)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_points_that_are_not_finite_stay_so_and_disturb_nobody(value: float) -> None:
    x = draw(60, 32, seed=0)
    key = unit(draw(9, 32, seed=1), torch.zeros(32))
    centre = 0.1 * draw(32, seed=2)
    with torch.no_grad():
        whole = point_shares(x, key, 0.1, centre=centre)
        x[7, 3] = value
        found = point_shares(x, key, 0.1, centre=centre)
    rest = torch.arange(60) != 7
    assert found[7].isnan().all()
    assert torch.equal(found[rest], whole[rest])


def test_a_point_at_the_centre_belongs_to_all_alike() -> None:
    centre = torch.ones(24)
    key = unit(draw(5, 24, seed=1), torch.zeros(24))
    with torch.no_grad():
        found = point_shares(centre.expand(3, -1), key, 0.1, centre=centre)
    assert torch.allclose(found, torch.full((3, 5), 0.2))


def test_tiny_temperatures_choose_the_best_key() -> None:
    x = draw(100, 16, seed=0)
    key = unit(draw(5, 16, seed=1), torch.zeros(16))
    with torch.no_grad():
        found = point_shares(x, key, 1e-38)
    best = (x.double() @ key.double().T).argmax(1)
    assert torch.allclose(found, torch.nn.functional.one_hot(best, 5).float(), atol=1e-6)


@QUICK
@given(st.integers(1, 70), st.integers(2, 20), st.integers(1, 700), st.integers(0, 99))
@example(64, 16, 481, 0)
@example(3, 7, 100, 0)
def test_maps_err_within_their_bounds(channels: int, regions: int, points: int, seed: int) -> None:
    x = draw(points, channels, seed=seed)
    centre = draw(channels, seed=seed + 1)
    share = members(points, regions, seed + 2)
    gain = draw(regions, channels, seed=seed + 3)
    matrix = draw(regions, channels, channels, seed=seed + 4)
    bias = draw(regions, channels, seed=seed + 5)
    wide = [each.double() for each in (x, centre, share, gain, matrix, bias)]
    away = (wide[0] - wide[1]).abs()
    terms = 2 * (channels + regions + 4) * U
    with torch.no_grad():
        gains = mixed_gains(x, centre, share, gain, bias)
        maps = mixed_maps(x, share, matrix, bias, centre=centre)
    truth = mixed_gains(wide[0], wide[1], wide[2], wide[3], wide[5])
    size = away * (wide[2] @ wide[3].abs()) + wide[2] @ wide[5].abs()
    rounded = U * (wide[0].abs() + wide[1].abs()) * (wide[2] @ wide[3].abs())
    assert ((gains.double() - truth).abs() <= terms * size + rounded).all()
    truth = mixed_maps(wide[0], wide[2], wide[4], wide[5], centre=wide[1])
    size = torch.einsum("nk,nc,kcd->nd", wide[2], away + wide[0].abs() + wide[1].abs(), wide[4].abs())
    assert ((maps.double() - truth).abs() <= terms * (size + wide[2] @ wide[5].abs())).all()


def test_one_point_alone_is_what_it_is_among_others() -> None:
    x = draw(700, 20, seed=0)
    share = members(700, 6, 1)
    matrix = draw(6, 20, 20, seed=2)
    bias = draw(6, 20, seed=3)
    with torch.no_grad():
        every = mixed_maps(x, share, matrix, bias)
        for n in (0, 1, 479, 480, 699):
            assert torch.equal(every[n], mixed_maps(x[n : n + 1], share[n : n + 1], matrix, bias)[0])


@QUICK
@given(st.integers(1, 40), st.lists(st.integers(1, 25), min_size=1, max_size=4), st.integers(0, 99))
@example(32, [20, 20], 0)
def test_nearest_codes_err_as_their_cosines(depth: int, codes: list[int], seed: int) -> None:
    points = 70
    x = draw(points, depth, seed=seed)
    centre = 0.2 * draw(depth, seed=seed + 1)
    middles = 0.2 * draw(len(codes), depth, seed=seed + 2)
    keys = [draw(count, depth, seed=seed + 3 + i) for i, count in enumerate(codes)]
    beyond = [draw(count, seed=seed + 9 + i).square() for i, count in enumerate(codes)]
    sizes = [torch.softmax(draw(count, seed=seed + 20 + i), 0) for i, count in enumerate(codes)]
    lower = torch.rand(points, len(codes), generator=torch.Generator().manual_seed(seed))
    views = torch.cat([centre[None], middles])
    table = mixture.nearest_codes(
        [shown_units(key, more, centre) for key, more in zip(keys, beyond, strict=True)],
        [shown_units(key, more, m) for key, more, m in zip(keys, beyond, middles, strict=True)],
        [size / 0.05 for size in sizes],
    )
    found = mixture.nearest(x, views, table, least=no_direction(views), lower=lower)
    best = torch.full((points,), -1.0, dtype=torch.float64)
    for i, (key, more, size) in enumerate(zip(keys, beyond, sizes, strict=True)):
        near = cosines(x.double(), key.double(), more.double(), centre.double(), middles[i].double())
        near, order = near.sort(1, descending=True)
        here = size.double()[order]
        taken = (0.05 - (here.cumsum(1) - here)).clamp_min(0).minimum(here)
        best = best.maximum((taken * near).sum(1) / taken.sum(1) - lower[:, i])
    # Cosines err by (D + 6) u; where two are as near, either may count: the mean moves by their difference.
    assert ((found.double() - best).abs() <= 4 * (depth + 8) * U + 1e-6).all()


def test_nearest_codes_of_nan_are_nan() -> None:
    x = draw(5, 8, seed=0)
    x[2, 1] = float("nan")
    zero = torch.zeros(8)
    key = draw(3, 8, seed=1)
    table = mixture.nearest_codes([unit(key, zero)], [unit(key, zero)], [torch.ones(3)])
    found = mixture.nearest(x, torch.zeros(2, 8), table, least=torch.zeros(2), lower=None)
    assert found.isnan().tolist() == [False, False, True, False, False]


def test_with_gradients_the_plain_forms_run() -> None:
    x = draw(10, 8, seed=0).requires_grad_()
    share = members(10, 3, 1)
    mixed_maps(x, share, draw(3, 8, 8, seed=2), draw(3, 8, seed=3)).sum().backward()  # type: ignore[no-untyped-call]
    assert x.grad is not None
    with torch.no_grad(), backend.plain():
        assert not mixture.usable(x.detach())
