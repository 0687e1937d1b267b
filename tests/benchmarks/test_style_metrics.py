"""Differences of style against their definitions."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.color import rgb_to_lab
from ssim_oracle import noise, ssim_oracle
from torch import Tensor

from benchmarks.style_metrics import (
    RegionStatistics,
    delta_e_2000,
    gaussian_distance,
    matched_regions,
    region_contrasts,
    relative_distance,
    srgb_to_lab,
    structure,
    style_distances,
)
from fprf.interfaces import Encoder

# Sharma, Wu, Dalal 2005, table 1: two colours in Lab and their difference, two pairs a line.
PUBLISHED = """
50.0000 2.6772 -79.7751 50.0000 0.0000 -82.7485 2.0425  50.0000 3.1571 -77.2803 50.0000 0.0000 -82.7485 2.8615
50.0000 2.8361 -74.0200 50.0000 0.0000 -82.7485 3.4412  50.0000 -1.3802 -84.2814 50.0000 0.0000 -82.7485 1.0000
50.0000 -1.1848 -84.8006 50.0000 0.0000 -82.7485 1.0000  50.0000 -0.9009 -85.5211 50.0000 0.0000 -82.7485 1.0000
50.0000 0.0000 0.0000 50.0000 -1.0000 2.0000 2.3669  50.0000 -1.0000 2.0000 50.0000 0.0000 0.0000 2.3669
50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0009 7.1792  50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0010 7.1792
50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0011 7.2195  50.0000 2.4900 -0.0010 50.0000 -2.4900 0.0012 7.2195
50.0000 -0.0010 2.4900 50.0000 0.0009 -2.4900 4.8045  50.0000 -0.0010 2.4900 50.0000 0.0010 -2.4900 4.8045
50.0000 -0.0010 2.4900 50.0000 0.0011 -2.4900 4.7461  50.0000 2.5000 0.0000 50.0000 0.0000 -2.5000 4.3065
50.0000 2.5000 0.0000 73.0000 25.0000 -18.0000 27.1492  50.0000 2.5000 0.0000 61.0000 -5.0000 29.0000 22.8977
50.0000 2.5000 0.0000 56.0000 -27.0000 -3.0000 31.9030  50.0000 2.5000 0.0000 58.0000 24.0000 15.0000 19.4535
50.0000 2.5000 0.0000 50.0000 3.1736 0.5854 1.0000  50.0000 2.5000 0.0000 50.0000 3.2972 0.0000 1.0000
50.0000 2.5000 0.0000 50.0000 1.8634 0.5757 1.0000  50.0000 2.5000 0.0000 50.0000 3.2592 0.3350 1.0000
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644  63.0109 -31.0961 -5.8663 62.8187 -29.7946 -4.0864 1.2630
61.2901 3.7196 -5.3901 61.4292 2.2480 -4.9620 1.8731  35.0831 -44.1164 3.7933 35.0232 -40.0716 1.5901 1.8645
22.7233 20.0904 -46.6940 23.0331 14.9730 -42.5619 2.0373  36.4612 47.8580 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.4410 91.1528 -1.6435 0.0447 1.4441  90.9257 -0.5406 -0.9208 88.6381 -0.8985 -0.7239 1.5381
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377  2.0776 0.0795 -1.1350 0.9033 -0.0636 -0.5514 0.9082
"""


def test_the_published_pairs() -> None:
    rows = torch.tensor([float(x) for x in PUBLISHED.split()], dtype=torch.float64).view(34, 7)
    found = delta_e_2000(rows[:, :3], rows[:, 3:6])
    assert (found - rows[:, 6]).abs().max() < 5e-5, "as many digits as were published"


def test_lab_is_that_of_another_library() -> None:
    image = torch.rand(1, 3, 40, 50, generator=torch.Generator().manual_seed(0))
    ours = srgb_to_lab(image[0].permute(1, 2, 0))
    assert torch.allclose(ours.float(), rgb_to_lab(image)[0].permute(1, 2, 0), atol=0.02)


def picture(height: int = 24, width: int = 30, seed: int = 0) -> torch.Tensor:
    """Noise with an edge."""
    return noise(height, width, seed) * torch.where(torch.arange(width) < width // 2, 1.0, 0.3)[:, None]


@settings(max_examples=10)
@given(st.integers(0, 1000), st.integers(11, 20), st.integers(11, 20))
def test_structure_is_the_written_out_one(seed: int, height: int, width: int) -> None:
    """SSIM's second factor of luminances with one mean and deviation."""
    a, b = picture(height, width, seed), picture(height, width, seed + 1)
    b = 0.5 * a + 0.5 * b
    greys = [image.double().numpy() @ np.array([[0.2126], [0.7152], [0.0722]]) for image in (a, b)]
    alike = [0.25 * (grey - grey.mean()) / grey.std() for grey in greys]
    assert structure(a, b) == pytest.approx(ssim_oracle(*alike, means=False), abs=1e-6)


@given(st.floats(0.05, 0.9), st.floats(0.0, 0.1), st.floats(0.1, 1.0))
def test_brightness_contrast_and_tint_cost_nothing(contrast: float, brightness: float, red: float) -> None:
    grey = picture()[..., :1].expand(-1, -1, 3)
    tinted = (contrast * grey + brightness) * torch.tensor([red, 1.0, 0.5])
    assert structure(grey, tinted) == pytest.approx(1.0, abs=1e-6)


class Pixels(Encoder):
    """Colours, plain or doubled, at the full size or a smaller one."""

    def __init__(self, gain: float = 1.0, stride: int = 1) -> None:
        super().__init__()
        self.gain, self.stride = gain, stride

    @property
    def identity(self) -> str:
        return "pixels"

    @property
    def channels(self) -> int:
        return 3

    def forward(self, image: Tensor) -> Tensor:
        return self.gain * torch.nn.functional.avg_pool2d(image, self.stride)


def statistics(seed: int, channels: int = 4) -> RegionStatistics:
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(channels, channels))
    return RegionStatistics(100, torch.from_numpy(draw.normal(size=channels)), torch.from_numpy(root @ root.T))


def draws(seed: int, mean: float = 0.5, spread: float = 0.1) -> Tensor:
    return mean + spread * torch.randn(12, 16, 3, generator=torch.Generator().manual_seed(seed))


HALVES = (torch.arange(16) >= 8).long().expand(12, 16)


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
    plain, style = draws(0), draws(1, mean=0.2, spread=0.2)
    halfway = (plain + style.mean(dim=(0, 1))) / 2
    rows = style_distances(
        {"plain": Pixels(), "doubled": Pixels(2.0)},
        [(plain, HALVES)],
        {"none": [(plain, HALVES)], "style": [(style, HALVES)], "half": [(halfway, HALVES)]},
        [(style, HALVES)],
    )
    assert rows["none"] == {"plain": 1.0, "doubled": 1.0, "mean": 1.0}
    assert rows["style"] == {"plain": 0.0, "doubled": 0.0, "mean": 0.0}
    assert 0.1 < (rows["half"]["mean"] or 0.0) < 0.9


def test_a_style_that_is_right_in_the_wrong_places_is_no_style() -> None:
    plain, style = draws(0), draws(1) + torch.where(HALVES == 0, 0.3, -0.3)[..., None]
    local, everywhere = (
        style_distances({"it": Pixels()}, [(plain, parts)], {"swapped": [(style.flip(1), parts)]}, [(style, parts)])
        for parts in (HALVES, torch.zeros_like(HALVES))
    )
    assert (local["swapped"]["mean"] or 0.0) > 1.5 and (everywhere["swapped"]["mean"] or 1.0) < 0.1


def test_regions_weigh_by_their_share_and_small_ones_not_at_all() -> None:
    def at(mean: float, cells: int) -> RegionStatistics:
        return RegionStatistics(cells, torch.tensor([mean]).double(), torch.zeros(1, 1).double())

    plain = {0: at(1.0, 30), 1: at(1.0, 10), 2: at(9.0, 4)}
    styled = {0: at(0.5, 30), 1: at(1.0, 10), 2: at(9.0, 4)}
    style = {0: at(0.0, 9), 1: at(0.0, 9), 2: at(0.0, 9), 3: at(5.0, 9)}
    assert relative_distance(plain, styled, style) == pytest.approx((30 * 0.5 + 10) / 40)
    assert relative_distance(style, style, style) is None
    assert relative_distance({7: at(1.0, 30)}, styled, style) is None


def bands(heights: tuple[int, ...], colours: list[tuple[float, float, float]]) -> Tensor:
    return torch.cat([torch.tensor(c).expand(h, 12, 3) for h, c in zip(heights, colours, strict=True)])


DAY = [(0.2, 0.4, 0.9), (0.9, 0.2, 0.2), (0.2, 0.8, 0.2)]
NIGHT = [(0.1, 0.15, 0.3), (0.3, 0.1, 0.08), (0.1, 0.28, 0.08)]


def test_bands_of_another_light_find_their_like() -> None:
    content, other, style = bands((8, 4, 12), DAY), bands((4, 12, 8), DAY), bands((8, 8, 8), NIGHT)
    here, there = matched_regions(Pixels(stride=2), [content, other], [style], regions=3, seed=0)
    assert [tuple(each.shape) for each in here] == [(12, 6), (12, 6)]
    sky, wall, grass = (int(there[0][row, 0]) for row in (1, 5, 9))
    assert len({sky, wall, grass}) == 3
    assert there[0].equal(torch.tensor([sky, wall, grass]).repeat_interleave(4)[:, None].expand(12, 6))
    assert here[0][:, 0].tolist() == [sky] * 4 + [wall] * 2 + [grass] * 6
    assert here[1][:, 0].tolist() == [sky] * 2 + [wall] * 6 + [grass] * 4


def test_contrast_follows_an_affine_change_of_light_and_not_the_borders() -> None:
    image = 0.2 + 0.3 * noise(40, 60)[..., :1].expand(-1, -1, 3)
    image[:, 30:] += 0.4  # an edge that lies on the regions' border
    regions = torch.zeros(40, 60)
    regions[:, 30:] = 1
    before, after = region_contrasts([(image, regions)]), region_contrasts([(0.5 * image + 0.1, regions)])
    assert before[0].gradient == pytest.approx(0.3 / 3, rel=0.1)  # mean distance of two uniform numbers
    assert (before[0].black, before[0].white) == pytest.approx((0.203, 0.497), abs=0.005)
    for kind in (0, 1):
        assert before[kind].pixels == after[kind].pixels == 39 * (28 if kind == 0 else 27)
        assert after[kind].gradient == pytest.approx(0.5 * before[kind].gradient, rel=1e-4)
        assert after[kind].black == pytest.approx(0.5 * before[kind].black + 0.1, abs=1e-5)
        assert after[kind].range == pytest.approx(0.5 * before[kind].range, rel=1e-4)
