"""Light on surfaces: the sun with hard shadows, the sky's ambient light, lamps, haze.

Lambertian throughout: what a surface point sends out is a function of the point, so that all views agree on it. Haze
too depends on the place (how far outside the street it lies), not on the camera.
"""

import numpy as np
from numpy.typing import NDArray

from .layout import END, Town
from .paint import foliage_normals, paint
from .palettes import Palette
from .shapes import Material
from .sky import sun_direction
from .texture import noise2, step
from .trace import shadowed

__all__ = ["shade"]

Colours = NDArray[np.float32]
Array = NDArray[np.float64]


def _linear(srgb: NDArray[np.floating]) -> Colours:
    low = srgb / 12.92
    return np.where(srgb <= 0.04045, low, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _encode(light: NDArray[np.floating]) -> Colours:
    """Linear light to sRGB through a shoulder that keeps highlights from clipping."""
    x = np.maximum(light, 0)
    x = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    x = np.clip(x, 0, 1)
    return np.asarray(np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055), np.float32)


def _normals(town: Town, face: NDArray[np.integer], points: Array) -> Colours:
    faces = town.faces
    flat = np.cross(faces.u, faces.v)
    round_ = (points - faces.centre[face]) * faces.curve[face]
    length = np.linalg.norm(round_, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0, round_ / np.maximum(length, 1e-12), flat[face]), np.float32)


def _occlusion(town: Town, points: Array, ground: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Share of the ambient light that reaches a point: less on the ground close to walls, hedges and cars."""
    open_ = np.ones(len(points), dtype=np.float32)
    at = np.flatnonzero(ground)
    at = at[np.argsort(points[at, 0], kind="stable")]  # then what one footprint can reach lies together
    x, y = points[at, 0].astype(np.float32), points[at, 1].astype(np.float32)
    least = np.ones(len(at), dtype=np.float32)
    for low_x, low_y, high_x, high_y, height in town.footprints.astype(np.float32):
        reach = min(0.5 * float(height), 2.0)
        part = slice(*np.searchsorted(x, [low_x - reach, high_x + reach]))
        dx = np.maximum(np.maximum(low_x - x[part], x[part] - high_x), 0)
        dy = np.maximum(np.maximum(low_y - y[part], y[part] - high_y), 0)
        near = 1 - np.minimum((dx + dy) / reach, 1)
        least[part] *= 1 - np.float32(0.45) * near * near
    open_[at] = least
    return open_


def _lamplight(town: Town, points: Array, normals: Colours, look: Palette) -> Colours:
    total = np.zeros(len(points), dtype=np.float32)
    p = points.astype(np.float32)
    for lamp in town.lamps.astype(np.float32):
        at = np.flatnonzero((np.abs(p[:, 0] - lamp[0]) < 14) & (np.abs(p[:, 1] - lamp[1]) < 14))
        to = lamp - p[at]
        square = (to * to).sum(1)
        facing = np.maximum((normals[at] * to).sum(1) / np.sqrt(square), 0)
        total[at] += facing * (1 - step(square, 60.0, 196.0)) / (square + 1.0)
    return total[:, None] * (np.array(look.light, dtype=np.float32) ** 1.5) * np.float32(look.lamps)


def shade(town: Town, look: Palette, face: NDArray[np.integer], points: Array) -> Colours:
    """sRGB colours [N 3] in [0, 1] of surface points [N 3] on faces [N] (>= 0)."""
    sun = sun_direction(look)
    normals = _normals(town, face, points)
    kinds = town.faces.material[face]
    leafy = np.flatnonzero(kinds == Material.FOLIAGE)
    distant = town.faces.style[face[leafy]] == 1
    lit = np.maximum(normals @ sun.astype(np.float32), 0)
    normals[leafy] = foliage_normals(points[leafy], normals[leafy], distant)
    bent = np.maximum(normals[leafy] @ sun.astype(np.float32), 0)
    lit[leafy] = np.where(lit[leafy] > 0, bent, 0) * 0.8 + 0.1 * bent
    albedo, glow = paint(town, face, points, normals, look)
    through = np.array([town.faces.material[k] == Material.FOLIAGE for k in town.first])
    facing = np.flatnonzero(lit > 0)
    solid, leaves = shadowed(town, points[facing], sun, through)
    # Light falls through crowns in patches, whose pattern runs along the sun's rays.
    across = np.cross(sun, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    a, b = points[facing] @ across, points[facing] @ np.cross(sun, across)
    dapple = step(noise2(2.2 * a, 2.2 * b, 121), 0.55, 0.8) * 0.7
    lit[facing] *= np.where(solid, 0, np.where(leaves, dapple, 1))
    up = (0.5 + 0.5 * normals[:, 2])[:, None]
    around = np.array(look.ambient) * up + np.array(look.bounce) * (1 - up)
    around = around * _occlusion(town, points, kinds == Material.GROUND)[:, None]
    light = lit[:, None] * np.array(look.sun) + around
    if look.lamps > 0:
        light = light + _lamplight(town, points, normals, look)
    colour = _linear(albedo) * light * look.exposure + glow * look.exposure
    outside = np.maximum(np.abs(points[:, 1]) - 9.0, np.maximum(town.start - points[:, 0], points[:, 0] - END))
    haze = (1 - np.exp(-np.maximum(outside, 0) / 40.0 * 2.0)) * look.haziness
    hazy = np.array(look.haze) * haze[:, None]
    return np.asarray(_encode(colour) * (1 - haze[:, None]) + hazy, np.float32)
