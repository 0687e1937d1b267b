import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import NumericsError
from fprf.style.statistics import kmeans


def blobs(n: int, d: int, k: int, *, spread: float, norm: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
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
def test_any_size_gives_non_empty_clusters_and_finite_centres(n: int, k: int, d: int, distinct: int, seed: int) -> None:
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


def test_the_next_centre_is_drawn_by_squared_distance() -> None:
    """The heavy row comes first; of the others the one twice as far is drawn four times as often (0.8, +- 4 deviations)."""
    x, weights = torch.tensor([[1.0, 0.0], [0.0, 0.0], [0.0, 2.0]]), torch.tensor([1.0, 1e9, 1.0])
    far = [bool((kmeans(x, 2, seed=seed, weights=weights).centres[:, 1] > 1.9).any()) for seed in range(300)]
    assert abs(sum(far) / 300 - 0.8) < 0.1


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
