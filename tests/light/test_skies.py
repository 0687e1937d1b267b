"""Pixels that look like the sky."""

import torch

from fprf.light.skies import heights, sky_pixels
from fprf.ops.rasterise.rendering import Pinhole

UP = torch.tensor([0.0, -1.0, 0.0])
K = torch.tensor([[80.0, 0.0, 48.0], [0.0, 80.0, 32.0], [0.0, 0.0, 1.0]])
CAMERA = Pinhole(K, torch.eye(4), 96, 64)


def test_what_has_the_colours_of_the_sky_nearby_and_stands_above_the_horizon_is_sky() -> None:
    image = torch.full((64, 96, 3), 0.15)
    image[:30] = torch.tensor([0.68, 0.70, 0.74])
    sure = torch.zeros(64, 96)
    sure[:20, :30] = 1.0  # the sure sky; between twigs on the right nobody knows
    image[:30, 40:60:3] = 0.2  # twigs
    image[12:28, 70:90] = 0.5  # a grey wall
    image[5:8, 62:66] = torch.tensor([0.2, 0.45, 0.9])  # a blue sheet
    image[50:60, 20:40] = torch.tensor([0.68, 0.70, 0.74])  # a pond
    found, followed = sky_pixels(image, sure, CAMERA, UP)
    assert float(found[:20, :40].min()) > 0.95
    assert float(found[:28, 41:60:3].min()) > 0.95
    assert float(found[:30, 40:60:3].max()) == 0.0
    assert float(found[12:28, 70:90].max()) == 0.0
    assert float(found[5:8, 62:66].max()) == 0.0
    assert float(found[33:].max()) == 0.0
    assert torch.equal(found, followed), "a grey sky is not followed"


def test_a_clear_sky_is_followed_to_where_it_is_darker_and_bluer() -> None:
    pale = torch.tensor([0.55, 0.70, 0.95])
    deep = torch.tensor([0.15, 0.35, 0.80])
    image = torch.lerp(pale, deep, torch.linspace(0, 1, 96)[:, None]).expand(64, 96, 3).clone()
    image[15:30, 60:80] = 0.9  # a white wall
    image[30:] = 0.15
    sure = torch.zeros(64, 96)
    sure[:20, :20] = 1.0
    found, followed = sky_pixels(image, sure, CAMERA, UP)
    assert float(found[:12, 70:].max()) == 0.0
    assert float(followed[:12, :80].min()) > 0.9
    assert float(followed[16:29, 61:79].max()) == 0.0


def test_without_a_sure_sky_nothing_is_sky() -> None:
    image = torch.full((64, 96, 3), 0.7)
    assert all(float(found.max()) == 0.0 for found in sky_pixels(image, torch.zeros(64, 96), CAMERA, UP))


def test_heights_are_those_of_rays() -> None:
    height = heights(CAMERA, UP)
    assert float(height[:32].min()) > 0 > float(height[32:].max())
    ray = torch.nn.functional.normalize(torch.tensor([(90.5 - 48) / 80, (3.5 - 32) / 80, 1.0]), dim=0)
    assert abs(float(height[3, 90] - ray @ UP)) < 1e-6
