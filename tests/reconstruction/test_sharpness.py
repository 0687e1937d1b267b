import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.reconstruction.images import choose, sharpness


def noise(height: int = 60, width: int = 80, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_sharpness_is_the_variance_of_the_laplacian() -> None:
    image = noise()
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
    around = np.pad(grey, 1, mode="reflect")
    laplacian = around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:] - 4 * grey
    assert sharpness(image) == pytest.approx(laplacian.var(), rel=1e-9)
    assert sharpness(np.full_like(image, 77)) == 0


def test_blur_lowers_it_step_by_step() -> None:
    image = noise(240, 320)
    scores = [sharpness(cv2.GaussianBlur(image, (0, 0), sigma)) for sigma in (0.5, 1, 2, 4)]
    assert scores == sorted(scores, reverse=True) and scores[0] > 20 * scores[-1]


def test_large_images_are_judged_at_a_moderate_size() -> None:
    large = cv2.resize(noise(60, 80), (3200, 2400), interpolation=cv2.INTER_CUBIC)
    small = cv2.resize(large, (960, 720), interpolation=cv2.INTER_AREA)
    assert sharpness(large) == pytest.approx(sharpness(small), rel=0.2)  # grey levels are rounded before, or after
    grey = cv2.cvtColor(large, cv2.COLOR_RGB2GRAY)
    assert sharpness(large) > 2 * cv2.Laplacian(grey, cv2.CV_64F).var()


@settings(deadline=None)
@given(st.lists(st.floats(0, 1e6), max_size=80), st.integers(1, 30), st.floats(0, 0.9))
def test_every_frame_is_chosen_or_has_a_reason(scores: list[float], count: int, least: float) -> None:
    choice = choose(scores, count, least)
    assert sorted([*choice.chosen, *choice.dropped]) == list(range(len(scores)))
    assert len(choice.chosen) <= count and choice.chosen == sorted(choice.chosen)
    assert all(choice.dropped.values())


@settings(deadline=None)
@given(st.lists(st.floats(1, 2), min_size=1, max_size=80), st.integers(1, 30))
def test_windows_are_even_and_give_their_sharpest(scores: list[float], count: int) -> None:
    chosen = choose(scores, count, 0.3).chosen  # none can be below 0.3 of its neighbours
    windows = min(count, len(scores))
    edges = [round(k * len(scores) / windows) for k in range(windows + 1)]
    assert len(chosen) == windows
    for frame, low, high in zip(chosen, edges, edges[1:], strict=False):
        assert low <= frame < high and scores[frame] == max(scores[low:high])


def test_a_blurred_stretch_gives_no_frame() -> None:
    scores = [100.0, 90, 110, 5, 4, 6, 95, 120, 80]
    choice = choose(scores, 3, 0.3)
    assert choice.chosen == [2, 7]
    assert choice.dropped[5] == "blurred, like all frames around it (sharpness 6, usual there is 115)"
    assert choice.dropped[3] == "less sharp than frame 5 (5 < 6)"
    assert choose(scores, 3, 0.0).chosen == [2, 5, 7]


def test_few_frames_are_all_windows() -> None:
    assert choose([1.0, 1.0, 1.0], 10, 0.3).chosen == [0, 1, 2]
    assert choose([], 10, 0.3) == ([], {})
    assert choose([2.0, 2.0], 1, 0.3).chosen == [0], "the first of equally sharp ones"
