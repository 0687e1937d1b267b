"""Scores of styles, matches, transfers and films against their definitions."""

import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from ssim_oracle import noise, ssim_oracle
from torch import Tensor

from benchmarks.semantic_matching import matching_rate
from benchmarks.steadiness import published, steadiness
from benchmarks.style_metrics import RegionStatistics, delta_e_2000, gaussian_distance, structure
from benchmarks.town.layout import build_town
from benchmarks.town.palettes import palette
from benchmarks.town.render import geometry, render, walk
from benchmarks.town.truth import short_path, town_view
from fprf.errors import DataError
from fprf.rendering.cameras import Cameras
from fprf.rendering.paths import pinhole

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


def picture(height: int = 24, width: int = 30, seed: int = 0) -> torch.Tensor:
    """Noise with an edge."""
    return noise(height, width, seed) * torch.where(torch.arange(width) < width // 2, 1.0, 0.3)[:, None]


@settings(max_examples=10)
@given(st.integers(0, 1000), st.integers(11, 20), st.integers(11, 20))
def test_structure_is_the_written_out_one(seed: int, height: int, width: int) -> None:
    """SSIM's second factor of luminances with one mean and deviation."""
    a = picture(height, width, seed)
    b = picture(height, width, seed + 1)
    b = 0.5 * a + 0.5 * b
    greys = [image.double().numpy() @ np.array([[0.2126], [0.7152], [0.0722]]) for image in (a, b)]
    alike = [0.25 * (grey - grey.mean()) / grey.std() for grey in greys]
    assert structure(a, b) == pytest.approx(ssim_oracle(*alike, means=False), abs=1e-6)


def statistics(seed: int, channels: int = 4) -> RegionStatistics:
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(channels, channels))
    return RegionStatistics(
        100, torch.from_numpy(draw.normal(size=channels)), torch.from_numpy(root @ root.T)
    )


@given(st.integers(0, 1000), st.integers(1, 6))
def test_the_full_distance_is_frechets(seed: int, channels: int) -> None:
    a = statistics(seed, channels)
    b = statistics(seed + 1, channels)
    product = np.linalg.eigvals(a.covariance.numpy() @ b.covariance.numpy())
    cross = np.sqrt(np.maximum(product.real, 0)).sum()
    square = (
        np.square((a.mean - b.mean).numpy()).sum()
        + np.trace(a.covariance)
        + np.trace(b.covariance)
        - 2 * cross
    )
    assert gaussian_distance(a, b, full=True) == pytest.approx(math.sqrt(max(0, float(square))), abs=1e-5)
    assert gaussian_distance(a, b, full=True) == pytest.approx(gaussian_distance(b, a, full=True), abs=1e-6)
    assert gaussian_distance(a, a, full=True) < 1e-5


def rate_oracle(a: np.ndarray, b: np.ndarray, la: np.ndarray, lb: np.ndarray, regions: list[int]) -> float:
    """Cell by cell, in float64."""
    centre = np.concatenate([a, b]).mean(0)
    a = a - centre
    b = b - centre
    hits: dict[int, list[bool]] = {r: [] for r in regions}
    for x, label in zip(a, la, strict=True):
        if label not in regions:
            continue
        best = {}
        for r in regions:
            like = sorted((x @ y / np.linalg.norm(x) / np.linalg.norm(y) for y in b[lb == r]), reverse=True)[
                :3
            ]
            best[r] = sum(like) / len(like)
        hits[label].append(max(best, key=lambda r: best[r]) == label)
    return float(np.mean([np.mean(hits[r]) for r in regions]))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 4), st.integers(6, 40), st.integers(6, 40))
def test_the_rate_is_the_written_out_one(seed: int, regions: int, n: int, m: int) -> None:
    draw = np.random.default_rng(seed)
    la, lb = (np.concatenate([np.arange(regions), draw.integers(-1, regions, k - regions)]) for k in (n, m))
    a, b = (draw.normal(size=(len(labels), 5)) + labels[:, None] for labels in (la, lb))
    tensors = [torch.from_numpy(x) for x in (a, b, la, lb)]
    found = matching_rate(*tensors, list(range(regions)))
    assert found == pytest.approx(rate_oracle(a, b, la, lb, list(range(regions))), abs=1e-12)


def colours(count: int, seed: int, low: float = 0.3, high: float = 0.7) -> Tensor:
    return low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))


FILM_WIDTH = 96
FILM_HEIGHT = 72
FILM_FRAMES = 8


@pytest.fixture(scope="module")
def path() -> Cameras:
    view = walk(seed=0, views=10, width=FILM_WIDTH, height=FILM_HEIGHT)[3]
    fov = math.degrees(2 * math.atan(FILM_HEIGHT / 2 / view.focal))
    start = pinhole(torch.from_numpy(view.pose)[None], width=FILM_WIDTH, height=FILM_HEIGHT, fov=fov)
    return short_path(start, FILM_FRAMES)


@pytest.fixture(scope="module")
def depths(path: Cameras) -> list[Tensor]:
    town = build_town(0)
    return [torch.from_numpy(geometry(town, town_view(path, i))[0]) for i in range(FILM_FRAMES)]


@pytest.fixture(scope="module")
def day(path: Cameras) -> list[Tensor]:
    town = build_town(0)
    look = palette("day")
    return [
        torch.from_numpy(render(town, town_view(path, i), look).rgb).float() / 255 for i in range(FILM_FRAMES)
    ]


def spoilt(frame: Tensor, k: int, fault: str, size: float) -> Tensor:
    """The k-th frame with a fault."""
    draw = torch.Generator().manual_seed(k)
    if fault == "blur":
        return torch.from_numpy(cv2.GaussianBlur(frame.numpy(), (0, 0), size))
    if fault == "drift":
        return frame + size * k / 7 * torch.tensor([1.0, 0.0, -1.0])
    return frame + size * torch.randn((3,) if fault == "flicker" else frame.shape, generator=draw)


def score(plain: list[Tensor], styled: list[Tensor], depths: list[Tensor], path: Cameras) -> float:
    found = steadiness(plain, styled, depths, path).score
    assert found is not None
    return found


def test_the_render_itself_scores_zero(day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    found = steadiness(day, day, depths, path)
    assert found.score == 0 and found.sharpness == 1
    assert found.short == found.plain_short and found.long == found.plain_long
    assert found.plain_short is not None and found.plain_short < 0.05, (
        "true depth warps a true picture onto the next"
    )
    assert found.valid_share > 0.4


@pytest.mark.parametrize(
    ("fault", "sizes"),
    [
        ("flicker", (0.01, 0.03, 0.09)),
        ("drift", (0.02, 0.06, 0.15)),
        ("blur", (0.5, 1, 2)),
        ("noise", (0.02, 0.05, 0.1)),
    ],
)
def test_faults_rank_by_their_size(
    fault: str, sizes: tuple[float, ...], day: list[Tensor], depths: list[Tensor], path: Cameras
) -> None:
    films = [[spoilt(frame, k, fault, size) for k, frame in enumerate(day)] for size in sizes]
    found = [0.0, *(score(day, frames, depths, path) for frames in films)]
    assert all(after > 1.3 * before + 0.01 for before, after in pairwise(found)), found


def test_a_camera_at_rest_compares_pixel_with_pixel() -> None:
    """Brighter by 0.01 with every frame: neighbours differ by that, frames 7 apart by seven times as much."""
    images = [torch.full((12, 12, 3), 0.2 + 0.01 * t) for t in range(9)]
    depths = [torch.full((12, 12), 2.0)] * 9
    still = pinhole(
        torch.eye(4, dtype=torch.float64)[None, :3].repeat(9, 1, 1), width=12, height=12, fov=53.0
    )
    found = published(images, depths, still)
    assert found["short"]["rmse"] == pytest.approx(0.01, rel=1e-4) and found["short"]["pairs"] == 8
    assert found["short"]["e_warp"] == pytest.approx(1e-4, rel=1e-4)
    assert 0 < found["short"]["lpips"] < found["long"]["lpips"] < 0.1
    assert found["long"]["rmse"] == pytest.approx(0.07, rel=1e-4) and found["long"]["pairs"] == 2
    nothing = published(images, [torch.zeros(12, 12)] * 9, still)
    assert nothing["short"] == {"rmse": None, "e_warp": None, "lpips": None, "pairs": 0}
    with pytest.raises(DataError):
        published(images[:2], depths, still)
