"""The sky by direction: gradient, clouds, the glow around the sun, stars."""

import math

import numpy as np
from numpy.typing import NDArray

from .palettes import Palette
from .texture import fractal2, hashed, step

__all__ = ["sky", "sun_direction"]

Colours = NDArray[np.float32]
Array = NDArray[np.float64]


def sun_direction(look: Palette) -> Array:
    """Unit vector towards the sun."""
    a, e = math.radians(look.azimuth), math.radians(look.elevation)
    return np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])


def sky(direction: Array, look: Palette) -> Colours:
    """sRGB colours [N 3] in [0, 1] of the sky in unit directions [N 3]."""
    height = np.clip(direction[:, 2], 0.0, 1.0)
    rise = step(height, -0.05, 0.75)[:, None] ** 0.7
    colour = np.array(look.horizon) * (1 - rise) + np.array(look.zenith) * rise
    # Clouds lie on a plane overhead; flattened towards the horizon, where they would alias.
    plane = direction[:, :2] / (height + 0.28)[:, None] * 2.2
    puff = 0.7 * fractal2(plane[:, 0], plane[:, 1], 131) + 0.3 * fractal2(3 * plane[:, 0], 3 * plane[:, 1], 133)
    cover = step(puff, 0.78 - 0.45 * look.cloudiness, 1.02 - 0.45 * look.cloudiness)[:, None] * 0.85
    toward = np.clip(direction @ sun_direction(look), 0, 1)[:, None]
    colour = colour + np.array(look.glow) * (toward**6 + 1.5 * toward**60)
    colour = colour * (1 - cover) + (np.array(look.clouds) * (0.86 + 0.2 * toward**4)) * cover
    if look.stars > 0:
        grid = direction[:, :2] / (height + 0.5)[:, None] * 26.0
        whole = np.floor(grid)
        i, j = whole.astype(np.int64).T
        apart = grid - whole - 0.3 - 0.4 * np.stack([hashed(141, i, j), hashed(142, i, j)], 1)
        star = np.exp(-(apart**2).sum(1) / 0.012) * (hashed(143, i, j) > 0.88) * hashed(144, i, j)
        colour = colour + look.stars * (star * (1 - cover[:, 0]))[:, None]
    return np.asarray(np.clip(colour, 0, 1), np.float32)
