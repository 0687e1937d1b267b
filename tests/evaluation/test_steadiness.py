"""On the town with its true depth: what is consistent scores nothing, faults score by their size."""

from collections.abc import Callable
from itertools import pairwise

import cv2
import pytest
import torch
from torch import Tensor

from fprf.errors import DataError, NumericsError
from fprf.evaluation.consistency import sharpness, steadiness
from fprf.evaluation.town_truth import short_path, town_view
from fprf.rendering.cameras import Cameras
from fprf.town.layout import build_town
from fprf.town.palettes import palette
from fprf.town.render import geometry, render, walk

WIDTH, HEIGHT, FRAMES = 96, 72, 8


@pytest.fixture(scope="module")
def path() -> Cameras:
    view = walk(seed=0, views=10, width=WIDTH, height=HEIGHT)[3]
    start = Cameras(
        pose=torch.from_numpy(view.pose)[None],
        focal=torch.full((1, 2), view.focal, dtype=torch.float64),
        centre=torch.tensor([[WIDTH / 2, HEIGHT / 2]], dtype=torch.float64),
        size=torch.tensor([[WIDTH, HEIGHT]]),
        distortion=torch.zeros(1, 6, dtype=torch.float64),
        lens=torch.zeros(1, dtype=torch.int64),
    )
    return short_path(start, FRAMES)


@pytest.fixture(scope="module")
def depths(path: Cameras) -> list[Tensor]:
    town = build_town(0)
    return [torch.from_numpy(geometry(town, town_view(path, i))[0]) for i in range(FRAMES)]


def film(path: Cameras, light: str) -> list[Tensor]:
    town, look = build_town(0), palette(light)
    return [torch.from_numpy(render(town, town_view(path, i), look).rgb).float() / 255 for i in range(FRAMES)]


@pytest.fixture(scope="module")
def day(path: Cameras) -> list[Tensor]:
    return film(path, "day")


def flicker(frames: list[Tensor], size: float) -> list[Tensor]:
    draw = torch.Generator().manual_seed(0)
    return [frame + size * torch.randn(3, generator=draw) for frame in frames]


def drift(frames: list[Tensor], size: float) -> list[Tensor]:
    return [frame + size * k / 7 * torch.tensor([1.0, 0.0, -1.0]) for k, frame in enumerate(frames)]


def blur(frames: list[Tensor], size: float) -> list[Tensor]:
    return [torch.from_numpy(cv2.GaussianBlur(frame.numpy(), (0, 0), size)) for frame in frames]


def noise(frames: list[Tensor], size: float) -> list[Tensor]:
    draw = torch.Generator().manual_seed(0)
    return [frame + size * torch.randn(frame.shape, generator=draw) for frame in frames]


def score(plain: list[Tensor], styled: list[Tensor], depths: list[Tensor], path: Cameras) -> float:
    found = steadiness(plain, styled, depths, path).score
    assert found is not None
    return found


def test_the_render_itself_scores_zero(day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    found = steadiness(day, day, depths, path)
    assert found.score == 0 and found.sharpness == 1
    assert found.short == found.plain_short and found.long == found.plain_long
    assert found.plain_short is not None and found.plain_short < 0.05, "true depth warps a true picture onto the next"
    assert found.valid_share > 0.4


def test_dull_and_inverted_colours_score_zero(day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    for recoloured in ([0.4 * x + 0.3 for x in day], [1 - x for x in day]):
        assert score(day, recoloured, depths, path) < 1e-3


@pytest.mark.parametrize("light", ["winter", "sunset", "night"])
def test_a_consistent_recolouring_scores_zero(light: str, day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    """Another palette is a new colour for every point of the town, the same from every view."""
    assert score(day, film(path, light), depths, path) < 0.02


@pytest.mark.parametrize(
    ("fault", "sizes"),
    [(flicker, (0.01, 0.03, 0.09)), (drift, (0.02, 0.06, 0.15)), (blur, (0.5, 1.0, 2.0)), (noise, (0.02, 0.05, 0.1))],
)
def test_faults_rank_by_their_size(
    fault: Callable[[list[Tensor], float], list[Tensor]],
    sizes: tuple[float, ...],
    day: list[Tensor],
    depths: list[Tensor],
    path: Cameras,
) -> None:
    found = [0.0, *(score(day, fault(day, size), depths, path) for size in sizes)]
    assert all(after > 1.3 * before + 0.01 for before, after in pairwise(found)), found


def test_faults_of_a_recoloured_film_are_seen_too(day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    night = film(path, "night")
    still = score(day, night, depths, path)
    for fault, size in ((flicker, 0.03), (drift, 0.06), (blur, 1.0)):
        assert score(day, fault(night, size), depths, path) > still + 0.05


def test_drift_shows_at_long_range_and_blur_in_sharpness_alone(day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    drifted = steadiness(day, drift(day, 0.1), depths, path)
    assert drifted.short is not None and drifted.long is not None
    assert drifted.long > 4 * drifted.short and drifted.sharpness == pytest.approx(1, abs=1e-3)
    blurred = steadiness(day, blur(day, 1.0), depths, path)
    assert blurred.sharpness is not None and blurred.sharpness < 0.7
    assert blurred.score is not None and blurred.score > 0.3, "a blur agrees with itself and must not win by it"


def test_sharpness_of_what_has_no_edges() -> None:
    flat = [torch.full((20, 20, 3), 0.5)]
    assert sharpness(flat, flat) is None
    assert sharpness([], []) is None


def test_short_paths_and_what_does_not_fit(day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    few = path.select(torch.arange(3))
    found = steadiness(day[:3], flicker(day[:3], 0.05), depths[:3], few)
    assert found.long is None and found.score is not None and found.score > 0.1
    nothing = steadiness(day[:3], day[:3], [torch.zeros(HEIGHT, WIDTH)] * 3, few)
    assert nothing.score is None and nothing.valid_share == 0
    with pytest.raises(DataError, match="3 plain and 2 stylised frames"):
        steadiness(day[:3], day[:2], depths[:3], few)
    with pytest.raises(NumericsError, match="not finite"):
        steadiness(day[:3], [x * float("nan") for x in day[:3]], depths[:3], few)
