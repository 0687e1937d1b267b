"""What a style adds to the inconsistency of a film: nothing where it is consistent, more with every fault."""

import math
from itertools import pairwise

import cv2
import pytest
import torch
from torch import Tensor

from benchmarks.steadiness import published, steadiness
from benchmarks.town.layout import build_town
from benchmarks.town.palettes import palette
from benchmarks.town.render import geometry, render, walk
from benchmarks.town.truth import short_path, town_view
from fprf.errors import DataError
from fprf.rendering.cameras import Cameras
from fprf.rendering.paths import pinhole

FILM_WIDTH, FILM_HEIGHT, FILM_FRAMES = 96, 72, 8


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


def film(path: Cameras, light: str) -> list[Tensor]:
    town, look = build_town(0), palette(light)
    return [torch.from_numpy(render(town, town_view(path, i), look).rgb).float() / 255 for i in range(FILM_FRAMES)]


@pytest.fixture(scope="module")
def day(path: Cameras) -> list[Tensor]:
    return film(path, "day")


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
    assert found.plain_short is not None and found.plain_short < 0.05, "true depth warps a true picture onto the next"
    assert found.valid_share > 0.4


def test_a_consistent_recolouring_scores_zero(day: list[Tensor], depths: list[Tensor], path: Cameras) -> None:
    """Another palette is a new colour for every point of the town, the same from every view."""
    assert score(day, film(path, "night"), depths, path) < 0.02
    for recoloured in ([0.4 * x + 0.3 for x in day], [1 - x for x in day]):
        assert score(day, recoloured, depths, path) < 1e-3


@pytest.mark.parametrize(
    ("fault", "sizes"),
    [("flicker", (0.01, 0.03, 0.09)), ("drift", (0.02, 0.06, 0.15)), ("blur", (0.5, 1, 2)), ("noise", (0.02, 0.05, 0.1))],
)
def test_faults_rank_by_their_size(
    fault: str, sizes: tuple[float, ...], day: list[Tensor], depths: list[Tensor], path: Cameras
) -> None:
    films = [[spoilt(frame, k, fault, size) for k, frame in enumerate(day)] for size in sizes]
    found = [0.0, *(score(day, frames, depths, path) for frames in films)]
    assert all(after > 1.3 * before + 0.01 for before, after in pairwise(found)), found


def test_a_camera_at_rest_compares_pixel_with_pixel() -> None:
    """Brighter by 0.01 with every frame: neighbours differ by that, frames 7 apart by seven times as much."""
    images, depths = [torch.full((12, 12, 3), 0.2 + 0.01 * t) for t in range(9)], [torch.full((12, 12), 2.0)] * 9
    still = pinhole(torch.eye(4, dtype=torch.float64)[None, :3].repeat(9, 1, 1), width=12, height=12, fov=53.0)
    found = published(images, depths, still)
    assert found["short"]["rmse"] == pytest.approx(0.01, rel=1e-4) and found["short"]["pairs"] == 8
    assert found["short"]["e_warp"] == pytest.approx(1e-4, rel=1e-4)
    assert 0 < found["short"]["lpips"] < found["long"]["lpips"] < 0.1
    assert found["long"]["rmse"] == pytest.approx(0.07, rel=1e-4) and found["long"]["pairs"] == 2
    nothing = published(images, [torch.zeros(12, 12)] * 9, still)
    assert nothing["short"] == {"rmse": None, "e_warp": None, "lpips": None, "pairs": 0}
    with pytest.raises(DataError):
        published(images[:2], depths, still)
