import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.errors import DataError
from fprf.evaluation.style_distance import (
    RegionStatistics,
    gaussian_distance,
    region_statistics,
    relative_distance,
    style_distances,
)
from fprf.interfaces import Encoder


class Pixels(Encoder):
    """Colours, plain or doubled."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.gain = gain

    @property
    def identity(self) -> str:
        return "pixels"

    @property
    def channels(self) -> int:
        return 3

    def forward(self, image: Tensor) -> Tensor:
        return self.gain * image


def statistics(seed: int, channels: int = 4) -> RegionStatistics:
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(channels, channels))
    return RegionStatistics(100, torch.from_numpy(draw.normal(size=channels)), torch.from_numpy(root @ root.T))


def noise(seed: int, mean: float = 0.5, spread: float = 0.1) -> Tensor:
    return mean + spread * torch.randn(12, 16, 3, generator=torch.Generator().manual_seed(seed))


HALVES = (torch.arange(16) >= 8).long().expand(12, 16)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 6))
def test_the_full_distance_is_frechets(seed: int, channels: int) -> None:
    a, b = statistics(seed, channels), statistics(seed + 1, channels)
    product = np.linalg.eigvals(a.covariance.numpy() @ b.covariance.numpy())
    cross = np.sqrt(np.maximum(product.real, 0)).sum()
    square = np.square((a.mean - b.mean).numpy()).sum() + np.trace(a.covariance) + np.trace(b.covariance) - 2 * cross
    assert gaussian_distance(a, b, full=True) == pytest.approx(math.sqrt(max(0, float(square))), abs=1e-5)
    assert gaussian_distance(a, b, full=True) == pytest.approx(gaussian_distance(b, a, full=True), abs=1e-6)
    assert gaussian_distance(a, a, full=True) < 1e-5


def test_statistics_are_those_of_the_regions_of_all_pictures() -> None:
    one, two = noise(0), noise(1)
    found = region_statistics(Pixels(), [(one, HALVES), (two, HALVES)])
    right = torch.cat([one[:, 8:].reshape(-1, 3), two[:, 8:].reshape(-1, 3)]).double()
    assert sorted(found) == [0, 1]
    assert found[1].cells == 2 * 12 * 8
    assert torch.allclose(found[1].mean, right.mean(0))
    assert torch.allclose(found[1].covariance, torch.cov(right.T, correction=0))


def test_coarse_labels_leave_their_borders_out() -> None:
    coarse = torch.tensor([[0, 1]])
    found = region_statistics(Pixels(), [(noise(0), coarse)])
    assert found[0].cells == found[1].cells == 96
    odd = torch.tensor([[0, 1, 1]])  # 16 columns over 3 cells: columns 5 lies in two of them
    assert region_statistics(Pixels(), [(noise(0), odd)])[0].cells == 12 * 5
    with pytest.raises(DataError, match="wholly in one region"):
        region_statistics(Pixels(), [(noise(0), torch.arange(24 * 32).reshape(24, 32))])


def test_no_change_is_one_and_the_reference_itself_is_zero() -> None:
    plain, style = noise(0), noise(1, mean=0.2, spread=0.2)
    halfway = (plain + style.mean(dim=(0, 1))) / 2
    rows = style_distances(
        {"plain": Pixels(), "doubled": Pixels(2.0)},
        [(plain, HALVES)],
        {"none": [(plain, HALVES)], "style": [(style, HALVES)], "half": [(halfway, HALVES)]},
        [(style, HALVES)],
    )
    assert rows["none"] == {"plain": 1.0, "doubled": 1.0, "mean": 1.0}
    assert rows["style"] == {"plain": 0.0, "doubled": 0.0, "mean": 0.0}
    half = rows["half"]["mean"]
    assert half is not None
    assert 0.1 < half < 0.9


def test_a_style_that_is_right_in_the_wrong_places_is_no_style() -> None:
    plain = noise(0)
    style = noise(1)
    style[:, :8] += 0.3
    style[:, 8:] -= 0.3
    swapped = style.flip(1)
    rows = style_distances({"it": Pixels()}, [(plain, HALVES)], {"swapped": [(swapped, HALVES)]}, [(style, HALVES)])
    whole = torch.zeros_like(HALVES)
    globally = style_distances({"it": Pixels()}, [(plain, whole)], {"swapped": [(swapped, whole)]}, [(style, whole)])
    assert rows["swapped"]["mean"] is not None
    assert globally["swapped"]["mean"] is not None
    assert rows["swapped"]["mean"] > 1.5
    assert globally["swapped"]["mean"] < 0.1


def test_regions_weigh_by_their_share_and_small_ones_not_at_all() -> None:
    def at(mean: float, cells: int) -> RegionStatistics:
        return RegionStatistics(cells, torch.tensor([mean]).double(), torch.zeros(1, 1).double())

    plain = {0: at(1.0, 30), 1: at(1.0, 10), 2: at(9.0, 4)}
    styled = {0: at(0.5, 30), 1: at(1.0, 10), 2: at(9.0, 4)}
    style = {0: at(0.0, 9), 1: at(0.0, 9), 2: at(0.0, 9), 3: at(5.0, 9)}
    assert relative_distance(plain, styled, style) == pytest.approx((30 * 0.5 + 10) / 40)
    assert relative_distance(style, style, style) is None
    assert relative_distance({7: at(1.0, 30)}, styled, style) is None


def test_layers_without_an_answer_are_left_out_of_the_mean() -> None:
    same = noise(0)
    rows = style_distances({"it": Pixels()}, [(same, HALVES)], {"none": [(same, HALVES)]}, [(same, HALVES)])
    assert rows == {"none": {"it": None, "mean": None}}
