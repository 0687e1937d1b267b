"""Moments, optimal transport and k-means against plain loops in float64."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import NumericsError
from fprf.style.statistics import covariance, deviation, empty, group_moments, kmeans, merge, moments, monge


def rows(
    n: int, c: int, *, scale: float = 1.0, offset: float = 0.0, seed: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return torch.randn(n, c, generator=g) * scale + offset, torch.rand(n, generator=g)


def two_pass(x: torch.Tensor, w: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Plain float64 loops."""
    mean = torch.zeros(x.shape[1]).double()
    scatter = torch.zeros(x.shape[1], x.shape[1]).double()
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
    left = empty(3)
    right = empty(3)
    for part in parts:
        left = merge(left, part)
    for part in reversed(parts):
        right = merge(part, right)
    whole = moments(x, w)
    scale = whole.scatter.abs().max().clamp_min(1e-12)
    for merged in (left, right):
        # Rounding of the means, offset * 2^-53, enters the scatter times its square root: far below its
        # scale.
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
    belongs[:, 2] = 0
    mean, covariances, share = group_moments(x, belongs)
    for k in range(5):
        one = moments(x, belongs[:, k])
        torch.testing.assert_close(mean[k], one.mean, rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(covariances[k], covariance(one), rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(share, belongs.double().sum(0) / belongs.double().sum(), rtol=1e-12, atol=0.0)
    assert not bool(mean[2].any()) and group_moments(x, 0 * belongs)[2].tolist() == [0.0] * 5


@pytest.mark.parametrize(
    ("mean", "variance", "floored"),
    [
        (
            [0.0] * 5,
            [25e-6, 1e-4, 4e-4, 1e-12, 0.0],
            [5e-3, 1e-2, 2e-2, 5e-5, 5e-5],
        ),  # a hundredth of the median
        ([1e4, 0.0, 1.0], [0.0] * 3, [1e-2] * 3),  # rounding of the largest mean
        ([0.0] * 3, [-1e-9, 1.0, 1.0], [1e-2, 1.0, 1.0]),  # a variance that rounding made negative
        ([1e6] * 3, [0.25] * 3, [1.0] * 3),
    ],
)
def test_deviation_biases_no_live_channel_and_floors_dead_ones(
    mean: list[float], variance: list[float], floored: list[float]
) -> None:
    given = torch.tensor(mean, dtype=torch.float64), torch.tensor(variance, dtype=torch.float64)
    found = deviation(*given)
    assert found.tolist() == pytest.approx(floored)


@pytest.mark.parametrize(("feature", "weight"), [(0.0, -1.0), (0.0, float("nan")), (float("inf"), 1.0)])
def test_one_bad_number_among_good_ones_is_refused(feature: float, weight: float) -> None:
    x, w = rows(20, 3)
    x[7, 1] = feature
    w[7] = weight
    with pytest.raises(NumericsError):
        moments(x, w)


def spectrum(
    c: int, *, rank: int | None = None, decay: float = 2.0, scale: float = 1.0, seed: int = 0
) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(c, c, generator=g, dtype=torch.float64))
    value = torch.logspace(0, -decay, c, dtype=torch.float64)
    value[c if rank is None else rank :] = 0
    return scale * (q * value) @ q.T


def with_ridge(c: torch.Tensor) -> torch.Tensor:
    return c + 1e-4 * c.diagonal().mean() * torch.eye(len(c), dtype=c.dtype)


@settings(max_examples=15, deadline=None)
@given(
    st.integers(1, 24),
    st.integers(0, 24),
    st.integers(0, 24),
    st.sampled_from([1e-4, 1.0, 1e4]),
    st.integers(0, 99),
)
def test_the_map_carries_one_covariance_to_the_other_at_any_rank(
    c: int, ra: int, rb: int, scale: float, seed: int
) -> None:
    content = spectrum(c, rank=min(ra, c), decay=4.0, seed=seed)
    style = spectrum(c, rank=min(rb, c), decay=3.0, scale=scale, seed=seed + 1)
    t = monge(content, style, gain=1e300)
    assert bool(t.isfinite().all())
    assert torch.equal(t, t.mT)
    assert float(torch.linalg.eigvalsh(t)[0]) >= -1e-9 * float(t.abs().max())
    if ra and rb:
        reached = t @ with_ridge(content) @ t
        aim = with_ridge(style)
        assert float((reached - aim).abs().max() / aim.abs().max()) < 1e-8


@pytest.mark.parametrize(("c", "rank"), [(1, 1), (7, 0), (7, 1), (64, 3), (128, 128)])
def test_equal_covariances_give_the_identity(c: int, rank: int) -> None:
    a = spectrum(c, rank=rank, decay=8.0)
    torch.testing.assert_close(monge(a, a, gain=1.0 + 1e-6), torch.eye(c).double(), rtol=0.0, atol=1e-9)


def test_gain_is_capped_where_the_scene_is_flat() -> None:
    flat = torch.zeros(5, 5)
    lively = torch.eye(5)
    torch.testing.assert_close(
        monge(flat, lively, gain=8.0), 8.0 * torch.eye(5).double(), rtol=1e-9, atol=1e-9
    )
    assert float(monge(lively, flat, gain=8.0).abs().max()) < 1e-6


def blobs(
    n: int, d: int, k: int, *, spread: float, norm: float, seed: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    label = torch.arange(n) % k
    centres = torch.randn(k, d, generator=g) * 8 * spread
    offset = torch.full((d,), norm / d**0.5)
    return centres[label] + torch.randn(n, d, generator=g) * spread + offset, label


@pytest.mark.parametrize("norm", [0.0, 3000.0, 1e5])
def test_the_result_is_a_fixed_point_of_lloyd_in_plain_float64(norm: float) -> None:
    x, _ = blobs(300, 6, 4, spread=0.3, norm=norm)
    found = kmeans(x, 4, seed=1)
    centres = torch.stack([x[found.label == i].double().mean(0) for i in range(4)])
    torch.testing.assert_close(found.centres.double(), centres, rtol=1e-6, atol=0.0)
    for row, label in zip(x.double(), found.label, strict=True):
        distance = (row - centres).square().sum(1)
        assert float(distance[label]) <= float(distance.min()) * (1 + 1e-6)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 40), st.integers(0, 12), st.integers(1, 4), st.integers(1, 6), st.integers(0, 99))
def test_any_size_gives_non_empty_clusters_and_finite_centres(
    n: int, k: int, d: int, distinct: int, seed: int
) -> None:
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(distinct, d, generator=g)[torch.randint(0, distinct, (n,), generator=g)]
    found = kmeans(x, k, seed=seed)
    assert len(found.centres) <= min(k, len(x.unique(dim=0)) if n else 0)
    assert bool(found.centres.isfinite().all())
    assert torch.equal(found.label.unique(), torch.arange(len(found.centres))) or k == 0
    again = kmeans(x, k, seed=seed)
    assert torch.equal(found.label, again.label) and torch.equal(found.centres, again.centres)


def test_weights_count_rows_several_times_and_zero_not_at_all() -> None:
    x, _ = blobs(60, 3, 3, spread=0.2, norm=0.0)
    weights = torch.randint(0, 4, (60,), generator=torch.Generator().manual_seed(0)).float()
    outlier = torch.cat([x, torch.full((1, 3), 1e6)])
    found = kmeans(outlier, 3, seed=0, weights=torch.cat([weights, torch.zeros(1)]))
    assert float(found.centres.abs().max()) < 100
    for i in range(3):
        inside = found.label[:-1] == i
        expected = (weights[inside].double() @ x[inside].double()) / weights[inside].sum()
        torch.testing.assert_close(found.centres[i].double(), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("value", "weight"), [(float("nan"), 1.0), (0.0, -1.0), (0.0, float("inf"))])
def test_bad_values_are_refused(value: float, weight: float) -> None:
    with pytest.raises(NumericsError):
        kmeans(torch.tensor([[1.0], [value]]), 1, seed=0, weights=torch.tensor([1.0, weight]))


def test_of_many_rows_a_sample_is_clustered_and_all_are_labelled() -> None:
    # Three kinds in turn: a regular sample could meet only one of them.
    x, label = blobs(60_000, 4, 3, spread=0.2, norm=100.0)
    found = kmeans(x, 3, seed=0)
    assert len(found.label) == 60_000
    assert len(torch.stack([label, found.label], 1).unique(dim=0)) == 3
    only = torch.zeros(60_000)
    only[[5, 59_999]] = 1.0
    torch.testing.assert_close(kmeans(x, 3, seed=0, weights=only).centres.sum(0), x[5] + x[59_999])
