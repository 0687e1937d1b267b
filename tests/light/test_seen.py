"""The sun of photographs: lit and shaded of one kind, and what only looks like it."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fprf.light.relight import SHOULDER, encoded
from fprf.light.seen import seen_sun

KINDS = ((0.10, 0.11, 0.12), (0.12, 0.20, 0.06), (0.25, 0.10, 0.07), (0.22, 0.20, 0.15))
"""Linear colours in the shade of strips that stand side by side."""
STRENGTH = np.array([3.0, 2.2, 1.3])


def picture(light: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Strips of materials in a light [H W 3] over that of the shade."""
    height, width = light.shape[:2]
    rng = np.random.default_rng(0)
    colour = np.empty((height, width, 3))
    for k, kind in enumerate(KINDS):
        colour[:, k * width // len(KINDS) : (k + 1) * width // len(KINDS)] = kind
    colour *= 1 + 0.02 * rng.standard_normal((height, width, 1))
    scene = torch.from_numpy(colour * light)
    pixels = encoded(scene / (1 + SHOULDER * scene))
    return np.rint(255 * pixels.clamp(0, 1).numpy()).astype(np.uint8)


def shadow(soft: float = 0.0) -> NDArray[np.float64]:
    """Light with a shadow across all strips, whose edges are so many pixels wide."""
    row = np.arange(288)[:, None, None] + np.zeros((1, 384, 1))
    lit = np.clip((np.abs(row - 150) - 40) / max(soft, 1e-3) + 0.5, 0, 1)
    return np.asarray(1 + STRENGTH * lit)


def test_strength_and_colour_are_found_whatever_the_materials() -> None:
    found = seen_sun(picture(shadow()))
    assert found is not None
    # 0.003 is added to light before logarithms are taken, a thirtieth of the darkest kind; the rest is noise.
    assert np.allclose(np.array(found.strength) + 1, STRENGTH + 1, rtol=0.06)


def test_softer_edges_are_those_of_a_larger_sun() -> None:
    sharp = seen_sun(picture(shadow()))
    soft = seen_sun(picture(shadow(soft=8.0)))
    assert sharp is not None and soft is not None
    assert sharp.degrees < 0.9 and soft.degrees > sharp.degrees + 0.5


@pytest.mark.parametrize("name", ["even", "slope", "one kind", "cool"])
def test_what_shows_no_sun_tells_nothing(name: str) -> None:
    light = shadow()
    shown = None
    if name == "even":
        light = np.ones_like(light)
    elif name == "slope":
        light = 1 + STRENGTH * np.linspace(0, 1, 288)[:, None, None] + np.zeros_like(light)
    elif name == "one kind":
        shown = np.zeros(light.shape[:2], np.bool_)
        shown[:, : light.shape[1] // len(KINDS)] = True
    else:
        light = light[..., ::-1]
    assert seen_sun(picture(light), shown) is None


def test_a_picture_of_a_few_pixels_tells_nothing() -> None:
    assert seen_sun(np.full((2, 3, 3), 90, np.uint8)) is None
