import math

import pytest
import torch

from fprf.errors import DataError
from fprf.evaluation.consistency import published
from fprf.rendering.cameras import Cameras

FRAMES = 9


def still() -> Cameras:
    pose = torch.eye(4, dtype=torch.float64)[None, :3].repeat(FRAMES, 1, 1)
    return Cameras(
        pose=pose,
        focal=torch.full((FRAMES, 2), 12.0, dtype=torch.float64),
        centre=torch.full((FRAMES, 2), 6.0, dtype=torch.float64),
        size=torch.full((FRAMES, 2), 12),
        distortion=torch.zeros(FRAMES, 6, dtype=torch.float64),
        lens=torch.zeros(FRAMES, dtype=torch.int64),
    )


def test_a_camera_at_rest_compares_pixel_with_pixel() -> None:
    """Brighter by 0.01 with every frame: neighbours differ by that, frames 7 apart by seven times as much."""
    images = [torch.full((12, 12, 3), 0.2 + 0.01 * t) for t in range(FRAMES)]
    found = published(images, [torch.full((12, 12), 2.0)] * FRAMES, still())
    assert found["short"]["rmse"] == pytest.approx(0.01, rel=1e-4) and found["short"]["pairs"] == 8
    assert found["short"]["e_warp"] == pytest.approx(1e-4, rel=1e-4)
    assert found["long"]["rmse"] == pytest.approx(0.07, rel=1e-4) and found["long"]["pairs"] == 2
    assert found["short"]["lpips"] is None


def test_the_mean_is_over_pairs_of_roots_and_of_squares() -> None:
    images = [torch.full((12, 12, 3), 0.1 * (t == 4)) for t in range(FRAMES)]
    short = published(images, [torch.full((12, 12), 2.0)] * FRAMES, still())["short"]
    assert short["rmse"] == pytest.approx(2 * 0.1 / 8, rel=1e-5)
    assert short["e_warp"] == pytest.approx(2 * 0.01 / 8, rel=1e-5)
    assert isinstance(short["e_warp"], float) and math.sqrt(short["e_warp"]) > 0.025


def test_nothing_to_compare() -> None:
    images = [torch.zeros(12, 12, 3)] * FRAMES
    found = published(images, [torch.zeros(12, 12)] * FRAMES, still())
    assert found["short"] == {"rmse": None, "e_warp": None, "lpips": None, "pairs": 0}
    with pytest.raises(DataError, match="2 images, 9 depths"):
        published(images[:2], [torch.zeros(12, 12)] * FRAMES, still())
