"""The sun that a capture was taken in."""

import math

import pytest
import torch
from torch import Tensor

from fprf.light.captured import LogLight, scene_light, sky_part
from fprf.light.relight import SHOULDER, Received, encoded

UP = torch.tensor([0.0, 0.0, 1.0])


def toward(azimuth: float, elevation: float) -> Tensor:
    a = math.radians(azimuth)
    e = math.radians(elevation)
    return torch.tensor([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])


def shown(light: Tensor) -> Tensor:
    """sRGB of scene light behind the shoulder."""
    return encoded(light / (1 + SHOULDER * light))


def surfaces(count: int = 4000) -> tuple[Received, Tensor]:
    """Surfaces that look everywhere, and what they send back of light."""
    draw = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=1)
    ones = torch.ones(count)
    kinds = torch.tensor([[0.3, 0.12, 0.08], [0.1, 0.2, 0.06], [0.25, 0.25, 0.25]])
    kind = torch.randint(0, 3, (count,), generator=draw)
    albedo = kinds[kind] * torch.exp(0.2 * torch.randn(count, 1, generator=draw))
    return Received(normals, ones, ones, ones), albedo


def meets(received: Received, sun: Tensor) -> Tensor:
    return (received.normals @ sun).clamp_min(0) / sky_part(received, UP)


def test_scene_light_is_that_before_the_shoulder() -> None:
    light = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 0.9
    assert torch.allclose(scene_light(shown(light)), light, atol=1e-4)


def log_light(light: Tensor, received: Received) -> LogLight:
    """Of surfaces that lie anywhere."""
    points = torch.randn(len(light), 3, generator=torch.Generator().manual_seed(1))
    return LogLight(shown(light), received, points, UP)


def test_a_sun_explains_what_it_lit_better_than_any_other() -> None:
    received, albedo = surfaces()
    true = toward(40.0, 35.0)
    strength = torch.tensor([3.0, 2.0, 1.5])
    sky = sky_part(received, UP)[:, None]
    found = log_light(0.4 * albedo * sky * (1 + strength * meets(received, true)[:, None]), received)
    best = found.evidence(meets(received, true))
    for azimuth in (-140.0, -50.0, 0.0, 80.0, 130.0):
        assert found.evidence(meets(received, toward(azimuth, 35.0))) < best
    assert 0.5 < found.explained(meets(received, true)) <= 1
    strengths = found.strengths(meets(received, true))
    assert float(strengths[0]) >= float(strengths[1]) >= float(strengths[2]) > 0
    assert torch.allclose(strengths, strength, atol=1.0)


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 200.0])
def test_under_clouds_no_sun_explains_anything(azimuth: float) -> None:
    received, albedo = surfaces()
    received = received._replace(openness=torch.rand(4000, generator=torch.Generator().manual_seed(2)))
    # A sky that lights level surfaces more than others looks like a high sun, but for what is told of it.
    found = log_light(albedo * sky_part(received, UP)[:, None], received)
    assert found.explained(meets(received, toward(azimuth, 40.0))) < 0.02
    assert found.evidence(meets(received, toward(azimuth, 80.0))) < 0.03
