"""Paint of the ground: lawn, asphalt with its markings, slabs, leaves and snow. Colours are sRGB."""

import numpy as np
from numpy.typing import NDArray

from .classes import LAWN, ROAD, SIDEWALK
from .layout import CROSSING, END, KERB, ROAD_HALF
from .palettes import Palette
from .surface import ground_class
from .texture import band, cells, fractal2, mix, noise2, step

__all__ = ["paint_ground"]

Colours = NDArray[np.float32]
Array = NDArray[np.float64]


def _lawn(x: Array, y: Array, look: Palette) -> Colours:
    share = 0.5 * fractal2(0.8 * x, 0.8 * y, 11) + 0.5 * fractal2(3.5 * x, 3.5 * y, 13)
    return mix(np.array(look.lawn[0]), np.array(look.lawn[1]), step(share, 0.2, 0.8))


def _road(x: Array, y: Array, look: Palette) -> Colours:
    worn = 0.86 + 0.22 * fractal2(0.5 * x, 1.1 * y, 21) + 0.10 * noise2(5 * x, 5 * y, 23)
    worn -= 0.08 * (band(np.abs(y) - 1.05, 0.25, 0.15) + band(np.abs(y) - 2.55, 0.25, 0.15))
    colour = (np.array(look.asphalt) * worn[:, None]).astype(np.float32)
    zebra = (x > CROSSING) & (x < CROSSING + 3.0) & (np.abs(y) < ROAD_HALF - 0.2)
    lane = band(y, 0.09) * band((x % 4.0) - 2.0, 1.1) * ~((x > CROSSING - 1.0) & (x < CROSSING + 4.0))
    edge = band(np.abs(y) - (ROAD_HALF - 0.3), 0.06) * ~zebra
    stripes = band((y % 1.0) - 0.5, 0.27) * zebra
    paint = np.maximum(np.maximum(lane, edge), stripes) * (0.72 + 0.28 * noise2(3 * x, 3 * y, 27))
    return mix(colour, np.array(look.marking), paint)


def _sidewalk(x: Array, y: Array, look: Palette) -> Colours:
    square = x > END
    brightness, joint = cells(x, y, 1.0, 0.8, 0.025, 0.5, 31)
    wide, seam = cells(x + y, x - y, 2.2, 2.2, 0.05, 0.0, 33)
    tone = 0.86 + 0.16 * np.where(square, wide, brightness) + 0.12 * noise2(2 * x, 2 * y, 35)
    tone -= 0.26 * np.where(square, seam, joint)
    colour = (np.array(look.slabs) * tone[:, None]).astype(np.float32)
    kerb = band(np.abs(y) - (ROAD_HALF + KERB / 2), KERB / 2) * ~square
    return mix(colour, np.array(look.slabs) * 1.18, kerb)


def paint_ground(points: Array, look: Palette) -> Colours:
    """Colours [N 3] of points of the ground."""
    x, y = points[:, 0], points[:, 1]
    kind = ground_class(points)
    colour = np.empty((len(points), 3), dtype=np.float32)
    for label, painter in ((LAWN, _lawn), (ROAD, _road), (SIDEWALK, _sidewalk)):
        at = np.flatnonzero(kind == label)
        colour[at] = painter(x[at], y[at], look)
    if look.littering > 0:
        share = np.array([0.0, 1.0, 0.3, 0.6], dtype=np.float32)[kind] * np.float32(look.littering)
        fallen = step(0.6 * noise2(6.5 * x, 6.5 * y, 41) + 0.4 * noise2(0.7 * x, 0.7 * y, 43) + 0.72 * share, 0.72, 0.82)
        hue = mix(np.array(look.litter) * 0.75, np.array(look.litter) * 1.25, noise2(6 * x, 6 * y, 45))
        colour = mix(colour, hue, fallen * 0.85)
    if look.snowing > 0:
        share = np.array([0.0, 1.0, 0.36, 0.72], dtype=np.float32)[kind] * np.float32(look.snowing)
        track = band(np.abs(y) - 1.05, 0.35, 0.25) + band(np.abs(y) - 2.55, 0.35, 0.25)
        share -= np.where(kind == ROAD, 0.22 * track, 0).astype(np.float32)
        lies = step((0.6 * fractal2(0.6 * x, 1.4 * y, 51) + 0.4 * noise2(4 * x, 4 * y, 55)) * 0.7 + share, 0.55, 0.82)
        tone = 0.94 + 0.06 * fractal2(1.6 * x, 1.6 * y, 53)
        colour = mix(colour, np.array(look.snow) * tone[:, None], lies * 0.95)
    return colour
