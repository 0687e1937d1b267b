import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import NumericsError
from fprf.style.statistics import covariance, dead_channels, deviation, empty, group_moments, merge, mix, moments


def rows(n: int, c: int, *, scale: float = 1.0, offset: float = 0.0, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return torch.randn(n, c, generator=g) * scale + offset, torch.rand(n, generator=g)


def two_pass(x: torch.Tensor, w: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Plain float64 loops."""
    mean, scatter = torch.zeros(x.shape[1]).double(), torch.zeros(x.shape[1], x.shape[1]).double()
    for row, weight in zip(x.double(), w.double(), strict=True):
        mean += weight * row
    mean /= w.double().sum()
    for row, weight in zip(x.double(), w.double(), strict=True):
        scatter += weight * torch.outer(row - mean, row - mean)
    return mean, scatter / w.double().sum()


def relative(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).abs().max() / b.abs().max())


@pytest.mark.parametrize("offset", [0.0, 10.0, 1e3, 1e4])
def test_moments_equal_a_two_pass_loop_at_any_offset(offset: float) -> None:
    x, w = rows(257, 5, offset=offset)
    mean, expected = two_pass(x, w)
    m = moments(x, w)
    assert relative(m.mean, mean) < 1e-13
    assert relative(covariance(m), expected) < 1e-11


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 90), st.integers(1, 7), st.integers(0, 10), st.sampled_from([0.0, 5.0, 1e3]))
def test_any_order_and_partition_gives_the_same(n: int, pieces: int, seed: int, offset: float) -> None:
    x, w = rows(n, 3, offset=offset, seed=seed)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    parts = [moments(x[i], w[i]) for i in order.chunk(pieces)] if n else [empty(3)]
    left, right = empty(3), empty(3)
    for part in parts:
        left = merge(left, part)
    for part in reversed(parts):
        right = merge(part, right)
    whole = moments(x, w)
    scale = whole.scatter.abs().max().clamp_min(1e-12)
    for merged in (left, right):
        # Rounding of the means, offset * 2^-53, enters the scatter times its square root: far below its scale.
        assert float((merged.scatter - whole.scatter).abs().max() / scale) < 1e-11
        assert float((merged.mean - whole.mean).abs().max()) <= 1e-12 * max(1.0, offset)
        assert float((merged.weight - whole.weight).abs()) <= 1e-12 * max(1.0, float(whole.weight))


def test_rows_of_weight_zero_count_for_nothing_whatever_they_hold() -> None:
    x, w = rows(9, 4)
    bad = torch.cat([x, torch.full((2, 4), float("nan"))])
    m = moments(bad, torch.cat([w, torch.zeros(2)]))
    assert all(torch.equal(a, b) for a, b in zip(m, moments(x, w), strict=True))


def test_group_moments_equal_moments_per_group() -> None:
    x, _ = rows(301, 4)
    belongs = torch.rand(301, 5) * (torch.rand(301, 5) > 0.5)
    mean, covariances, share = group_moments(x, belongs)
    for k in range(5):
        one = moments(x, belongs[:, k])
        torch.testing.assert_close(mean[k], one.mean, rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(covariances[k], covariance(one), rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(share, belongs.double().sum(0) / belongs.double().sum(), rtol=1e-12, atol=0.0)


def test_deviation_biases_no_live_channel_and_floors_dead_ones() -> None:
    sigma = torch.tensor([5e-3, 1e-2, 2e-2, 1e-6, 0.0], dtype=torch.float64)
    floored = deviation(torch.zeros(5).double(), sigma.square())
    assert torch.equal(floored[:3], sigma.square().sqrt()[:3])
    torch.testing.assert_close(floored[3:], torch.full((2,), 5e-5, dtype=torch.float64), rtol=1e-12, atol=0.0)


def test_dead_channels_are_those_that_are_floored() -> None:
    sigma = torch.tensor([1.0, 0.5, 2.0, 1e-3, 0.0, 0.9, 0.006])
    assert dead_channels(torch.zeros(6), sigma.square()).tolist() == [False, False, False, True, True, False, False]
    assert dead_channels(torch.full((3,), 1e6), torch.full((3,), 0.25)).all(), "rounding of the mean"
    assert not dead_channels(torch.zeros(4), torch.ones(4)).any()


def test_groups_of_nothing_have_no_share() -> None:
    mean, spread, share = group_moments(torch.randn(5, 3), torch.zeros(5, 2))
    assert share.tolist() == [0.0, 0.0] and not bool(mean.any()) and not bool(spread.any())


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf")])
def test_one_bad_number_among_good_ones_is_refused(bad: float) -> None:
    x, w = rows(20, 3)
    w[7] = bad
    with pytest.raises(NumericsError, match="a weight"):
        moments(x, w)
    x, w = rows(20, 3)
    x[7, 1] = bad
    if bad != -1.0:
        with pytest.raises(NumericsError, match="a content feature"):
            moments(x, w)


def test_the_largest_mean_says_what_rounding_is() -> None:
    found = deviation(torch.tensor([1e4, 0.0, 1.0]), torch.zeros(3))
    assert found.tolist() == pytest.approx([1e-2] * 3)


def test_weights_are_shares_of_whatever_they_sum_to() -> None:
    """Half a row's weight is as good as ten rows'; shares of groups need not sum to 1."""
    x = torch.randn(50, 3, dtype=torch.float64)
    light, heavy = (covariance(moments(x, torch.full((50,), w))) for w in (0.002, 20.0))
    torch.testing.assert_close(light, heavy, rtol=1e-12, atol=0.0)
    means, spreads = torch.randn(4, 3), torch.eye(3).expand(4, 3, 3)
    share = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    for one, other in zip(mix(means, spreads, share), mix(means, spreads, 7 * share), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


def test_a_variance_that_rounding_made_negative_is_none() -> None:
    mean, variance = torch.zeros(3), torch.tensor([-1e-9, 1.0, 1.0])
    assert deviation(mean, variance).tolist() == pytest.approx([0.01, 1.0, 1.0])
    assert dead_channels(mean, variance).tolist() == [True, False, False]
