"""Colours and emitted light of all surface points, by material. Colours are sRGB, light is linear."""

import numpy as np
from numpy.typing import NDArray

from .ground import paint_ground
from .layout import Town
from .palettes import Palette
from .shapes import Material
from .surface import on_face
from .texture import band, cells, fractal2, fractal3, mix, noise3, step
from .walls import paint_walls

__all__ = ["foliage_normals", "paint"]

Colours = NDArray[np.float32]
Array = NDArray[np.float64]
_WOOD_RATE, _LEAF_RATE = 1.2, 4.2
"""Noise cells per metre in the distant wood and in near crowns."""


def foliage_normals(points: Array, normals: Colours, distant: NDArray[np.bool_]) -> Colours:
    """Normals [N 3] roughened by leaves; a function of the point alone."""
    p = points * np.where(distant, 0.9, 3.4)[:, None]
    x, y, z = p.T
    rough = np.stack([noise3(x, y, z, 81 + i) for i in range(3)], 1) - np.float32(0.5)
    bent = normals + np.float32(1.7) * rough
    return np.asarray(bent / np.linalg.norm(bent, axis=1, keepdims=True), np.float32)


def _foliage(town: Town, face: NDArray[np.integer], points: Array, normals: Colours, look: Palette) -> Colours:
    pairs = np.array(look.leaves, dtype=np.float32)[town.faces.tint[face]]
    distant = town.faces.style[face] == 1
    rate = np.where(distant, _WOOD_RATE, _LEAF_RATE)[:, None]
    fine = fractal3(points * rate, 1.0, 91)
    broad = fractal3(points * rate * 0.3, 1.0, 95)
    colour = mix(pairs[:, 0], pairs[:, 1], step(0.6 * fine + 0.4 * broad, 0.15, 0.85))
    colour = colour * (0.70 + 0.30 * step(fine, 0.15, 0.5))[:, None]
    return _snowed(colour, fine, normals, look, 0.85)


def _snowed(colour: Colours, noise: NDArray[np.float32], normals: Colours, look: Palette, most: float) -> Colours:
    """Snow on what faces upward."""
    if look.snowing == 0:
        return colour
    lies = step(normals[:, 2] + 0.7 * (noise - 0.5), 0.25, 0.6) * np.float32(most * look.snowing)
    return mix(colour, np.array(look.snow), lies)


def _roof(town: Town, face: NDArray[np.integer], points: Array, normals: Colours, look: Palette) -> Colours:
    u, v = on_face(town.faces, face, points)
    base = np.array(look.roofs, dtype=np.float32)[town.faces.tint[face]]
    flat = town.faces.style[face] == 1
    base = np.where(flat[:, None], np.array(look.slabs, dtype=np.float32) * np.float32(0.8), base)
    number, joint = cells(u, v, 0.5, 0.38, 0.02, 0.5, 101)
    broad = fractal2(0.6 * u, 0.6 * v, 103)
    tone = 0.80 + 0.16 * number + 0.20 * broad + 0.10 * (v % 0.38) / 0.38 - 0.28 * joint
    colour = (base * np.where(flat, 0.85 + 0.2 * broad, tone)[:, None]).astype(np.float32)
    high = town.faces.extent[face][:, 1]
    ridge = band(v - high, 0.18) * ~flat
    colour = mix(colour, base * 0.72, ridge)
    return _snowed(colour, broad + 0.2, normals, look, 0.95)


def _car(kind: Material, town: Town, face: NDArray[np.integer], points: Array, look: Palette) -> Colours:
    z = points[:, 2]
    if kind == Material.TYRE:
        hub = band(np.linalg.norm((points - town.faces.centre[face])[:, [0, 2]], axis=1), 0.16)
        return mix(np.full(3, 0.09), np.full(3, 0.55), hub * (np.abs(points[:, 2] - 0.33) < 0.2))
    paint = np.array(look.paints, dtype=np.float32)[town.faces.tint[face]]
    if kind == Material.PAINT:
        colour = mix(paint, paint * 1.15, step(z, 0.5, 1.5))
        return mix(colour, np.full(3, 0.12), band(z - 0.3, 0.1))
    u, v = on_face(town.faces, face, points)
    wide, high = town.faces.extent[face].T
    shade = mix(np.array(look.glass[0]) * 0.8, np.array(look.glass[1]), step(v / high, 0.1, 1.2))
    side = town.faces.style[face] == 1
    edge = np.minimum(high - v, np.minimum(u, wide - u))
    frame = np.where(side, np.maximum(band(u - 0.52 * wide, 0.05), 1 - step(high - v, 0.04, 0.1)), 1 - step(edge, 0.04, 0.1))
    return mix(shade, paint, frame)


def _plain(kind: Material, points: Array, look: Palette) -> Colours:
    if kind == Material.TRUNK:
        x, y, z = (points * np.array([9.0, 9.0, 1.6])).T
        streak = noise3(x, y, z, 111)
        return mix(np.array(look.bark) * 0.7, np.array(look.bark) * 1.25, streak)
    if kind == Material.LANTERN:
        return mix(np.array(look.light), np.array(look.trim), np.full(len(points), 0.6))
    base = np.array(look.iron if kind == Material.POST else look.trim, dtype=np.float32)
    return (base * (0.82 + 0.18 * fractal3(points, 2.0, 113))[:, None]).astype(np.float32)


def paint(town: Town, face: NDArray[np.integer], points: Array, normals: Colours, look: Palette) -> tuple[Colours, Colours]:
    """Colours (sRGB) and emitted light (linear), [N 3] each, of points on faces [N], none of them the sky."""
    colour = np.zeros((len(points), 3), dtype=np.float32)
    glow = np.zeros_like(colour)
    kinds = town.faces.material[face]
    for kind in Material:
        at = np.flatnonzero(kinds == kind)
        if len(at) == 0:
            continue
        f, p, n = face[at], points[at], normals[at]
        if kind == Material.GROUND:
            colour[at] = paint_ground(p, look)
        elif kind == Material.FACADE:
            colour[at], glow[at] = paint_walls(town.faces, f, p, look)
        elif kind == Material.ROOF:
            colour[at] = _roof(town, f, p, n, look)
        elif kind == Material.FOLIAGE:
            colour[at] = _foliage(town, f, p, n, look)
        elif kind in (Material.PAINT, Material.GLASS, Material.TYRE):
            colour[at] = _snowed(_car(kind, town, f, p, look), np.full(len(at), 0.5, np.float32), n, look, 0.9)
        else:
            colour[at] = _plain(kind, p, look)
        if kind == Material.LANTERN:
            glow[at] = np.array(look.light) * min(look.lamps, 3.0)
    return np.clip(colour, 0.0, 1.0), glow
