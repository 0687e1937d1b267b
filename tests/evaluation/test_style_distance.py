import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.evaluation.metrics import RegionStatistics, gaussian_distance, relative_distance, style_distances
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
