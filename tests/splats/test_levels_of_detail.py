"""Levels of detail: nothing that is seen is left out, moments are kept, and what is merged does not show."""

from dataclasses import replace

import pytest
import torch
from splat_ball import ball, equal

from fprf.ops.rasterise.rendering import Pinhole
from fprf.splats.gaussians import Gaussians
from fprf.splats.levels import make_levels_of_detail
from fprf.splats.views import draw


def _scattered(count: int) -> Gaussians:
    """Small Gaussians in a ball of radius 10."""
    found = ball(count)
    return replace(found, means=10 * found.means, log_scales=found.log_scales - 1)


def _camera(distance: float, focal: float) -> Pinhole:
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = distance
    intrinsics = torch.tensor([[focal, 0, 48], [0, focal, 32], [0, 0, 1]], dtype=torch.float64)
    return Pinhole(intrinsics, pose, 96, 64, 0.01)


@pytest.mark.parametrize(
    ("distance", "focal", "pixels", "error", "left"),
    [
        (0.0, 100.0, 0.0, 1e-5, 1.0),
        (5.0, 300.0, 0.0, 1e-5, 1.0),
        (-5.0, 100.0, 0.0, 1e-5, 1.0),
        (300.0, 300.0, 1.0, 2 / 255, 0.75),
    ],
)
def test_culling_and_merging_within_a_pixel_do_not_show_and_save(
    distance: float, focal: float, pixels: float, error: float, left: float
) -> None:
    gaussians, camera = _scattered(20_000), _camera(distance, focal)
    shown = make_levels_of_detail(gaussians).select(camera, pixels)
    apart = draw(gaussians, camera, antialiased=True).image - draw(shown, camera, antialiased=True).image
    assert float(apart.square().mean()) ** 0.5 < error and len(shown) < left * len(gaussians)


def test_equal_gaussians_merge_into_one_of_them() -> None:
    one = ball(1)
    many = one.select(torch.zeros(64, dtype=torch.int64))
    found = make_levels_of_detail(many).select(_camera(10.0, 100.0), 0.5)
    assert len(found) == 1
    assert torch.allclose(found.means, one.means, atol=1e-5) and torch.allclose(found.harmonics, one.harmonics, atol=1e-5)
    assert torch.allclose(found.log_scales.sort().values, one.log_scales.sort().values, atol=1e-4)


def test_a_look_shows_the_levels_of_recoloured_gaussians() -> None:
    gaussians = _scattered(20_001)
    new = -gaussians.harmonics * (torch.arange(20_001) % 7)[:, None, None]
    wanted, found = make_levels_of_detail(gaussians.recoloured(new)), make_levels_of_detail(gaussians).recoloured(new)
    for distance, pixels in ((100.0, 0.0), (100.0, 1.0), (300.0, 1.0), (5.0, 1.0)):
        camera = _camera(distance, 300.0)
        assert equal(wanted.select(camera, pixels), found.select(camera, pixels))
    assert len(found.select(_camera(-1e4, 300.0), 1.0)) == 0
