"""Paint of facades: walls by style, windows, doors, shutters. Colours are sRGB, emitted light is linear."""

import numpy as np
from numpy.typing import NDArray

from .buildings import PLINTH, STOREY
from .layout import FaceTable
from .palettes import Palette
from .surface import Parts, facade_parts, on_face
from .texture import band, cells, fractal2, hashed, mix, noise2, step

__all__ = ["paint_walls"]

Colours = NDArray[np.float32]
Array = NDArray[np.float64]
_BRICK, _PLASTER, _CLAPBOARD, _TIMBER, _STONE = range(5)


def _choose(colours: tuple[tuple[float, float, float], ...], index: NDArray[np.integer]) -> Colours:
    return np.asarray(np.array(colours, dtype=np.float32)[index % len(colours)])


def _some(parts: Parts, at: NDArray[np.int64]) -> Parts:
    return Parts(
        window=parts.window[at],
        door=parts.door[at],
        shutter=parts.shutter[at],
        across=parts.across[at],
        up=parts.up[at],
        half=parts.half[at],
        tall=parts.tall[at],
        column=parts.column[at],
        storey=parts.storey[at],
    )


def _bare(style: int, tint: NDArray[np.int64], u: Array, v: Array, look: Palette) -> Colours:
    """A wall without openings."""
    broad = fractal2(0.7 * u, 0.7 * v, 61)
    if style == _BRICK:
        number, joint = cells(u, v, 0.62, 0.3, 0.018, 0.5, 63)
        colour = _choose(look.bricks, tint) * (0.80 + 0.30 * number + 0.14 * broad)[:, None]
        return mix(colour, np.array(look.slabs), joint * 0.5)
    base = _choose(look.walls, tint)
    if style == _CLAPBOARD:
        within = (v % 0.36) / 0.36
        tone = 0.90 + 0.10 * within + 0.06 * broad - 0.26 * band((v % 0.36) - 0.03, 0.035, 0.025)
        return np.asarray(base * tone[:, None], np.float32)
    if style == _STONE:
        number, joint = cells(u, v, 1.1, 0.55, 0.025, 0.5, 65)
        tone = 0.84 + 0.20 * number + 0.12 * broad - 0.22 * joint
        return np.asarray(np.array(look.stone) * tone[:, None], np.float32)
    tone = 0.90 + 0.10 * broad + 0.07 * noise2(4 * u, 4 * v, 67)
    return np.asarray(base * tone[:, None], np.float32)


def _timber(u: Array, v: Array, parts: Parts, pitch: Array) -> NDArray[np.float32]:
    """Beams of a half-timbered wall: posts between the windows, sills, and braces in every other bay."""
    floor = v - PLINTH
    posts = band(np.abs(parts.across) - pitch / 2, 0.12) + band(np.abs(parts.across) - parts.half - 0.09, 0.08)
    level = floor % STOREY
    sills = band(np.minimum(level, STOREY - level), 0.12) + band(level - 0.24 * STOREY, 0.07)
    slant = (np.abs(parts.across) - parts.half - 0.1) - (level - 0.25 * STOREY) * 0.32
    brace = band(slant, 0.09) * (level > 0.25 * STOREY)
    return np.clip(posts + sills + brace, 0, 1).astype(np.float32)


def _window(parts: Parts, key: NDArray[np.float32], look: Palette) -> tuple[Colours, Colours]:
    height = np.clip(parts.up / parts.tall, 0, 1)
    pane = mix(np.array(look.glass[0]), np.array(look.glass[1]), 0.25 + 0.6 * height * (0.5 + key))
    drape = band(np.abs(parts.across) - parts.half, 0.34 * parts.half, 0.04) * (key * 7 % 1 < 0.5)
    colour = mix(pane, np.array(look.trim) * 0.8, drape * 0.6)
    edge = np.minimum(parts.half - np.abs(parts.across), np.minimum(parts.up, parts.tall - parts.up))
    bars = np.maximum(band(parts.across, 0.035), band(parts.up - 0.64 * parts.tall, 0.035))
    frame = np.maximum(1 - step(edge, 0.07, 0.11), bars)
    lit = (key < look.lit) * (0.30 + 0.50 * (key * 13 % 1)) * (1.15 - 0.45 * height) * (1 - 0.45 * drape)
    glow = np.array(look.light) ** 3.0 * (lit * (1 - 0.85 * frame))[:, None]
    return mix(colour, np.array(look.trim), frame), glow.astype(np.float32)


def _door(parts: Parts, tint: NDArray[np.int64], look: Palette) -> Colours:
    side, up = np.abs(parts.across), parts.up
    panel = band(side - 0.25, 0.16) * np.maximum(band(up - 0.55, 0.32), band(up - 1.3, 0.28))
    light = band(side, 0.40) * band(up - 1.92, 0.16)
    colour = _choose(look.doors, tint) * (1 - 0.32 * panel)[:, None]
    colour = mix(colour, np.array(look.glass[1]), light)
    frame = np.maximum(band(side - 0.62, 0.1), band(up - 2.35, 0.1))
    return mix(colour, np.array(look.trim), frame)


def paint_walls(faces: FaceTable, face: NDArray[np.integer], points: Array, look: Palette) -> tuple[Colours, Colours]:
    """Colours and emitted light, [N 3] each, of points on facades."""
    u, v = on_face(faces, face, points)
    parts = facade_parts(faces, face, u, v)
    tint, style = faces.tint[face], faces.style[face]
    wide = faces.extent[face][:, 0]
    columns, storeys = faces.columns[face], faces.storeys[face]
    colour = np.empty((len(points), 3), dtype=np.float32)
    for kind in range(5):
        at = np.flatnonzero(style == kind)
        colour[at] = _bare(kind, tint[at], u[at], v[at], look)
    house = (storeys > 0) & (style != _STONE)
    pitch = wide / np.maximum(columns, 1)
    beams = _timber(u, np.where(house, v, v + PLINTH), parts, pitch) * ((style == _TIMBER) & (columns > 0))
    colour = mix(colour, np.array(look.timber), beams * 0.92)
    level = (v - PLINTH) % STOREY
    cornice = band(np.minimum(level, STOREY - level), 0.1) * house * ((style == _PLASTER) | (style == _BRICK))
    corner = band(np.minimum(u, wide - u), 0.16) * house * (style != _TIMBER)
    sill = band(parts.up + 0.06, 0.06) * band(parts.across, parts.half + 0.12)
    lintel = band(parts.up - parts.tall - 0.09, 0.09) * band(parts.across, parts.half + 0.1) * (style != _TIMBER)
    above = (parts.storey >= 0) & (parts.storey < np.maximum(storeys, 1)) & (columns > 0) & ~parts.door
    opening = np.maximum(sill, lintel) * (above & ~((parts.column == faces.door[face]) & (parts.storey == 0)))
    colour = mix(colour, np.array(look.trim) * 0.95, np.maximum(np.maximum(cornice, corner), opening) * 0.85)
    plinth = band(v - PLINTH / 2, PLINTH / 2) * house
    colour = mix(colour, np.array(look.stone) * 0.72, plinth)
    slats = 0.82 + 0.25 * band((parts.up % 0.24) - 0.12, 0.075, 0.03)
    shut = _choose(look.shutters, tint // 2) * slats[:, None]
    colour = np.where(parts.shutter[:, None], shut, colour)
    glow = np.zeros_like(colour)
    at = np.flatnonzero(parts.window)
    key = hashed(71, face.astype(np.int64), parts.column, parts.storey)
    colour[at], glow[at] = _window(_some(parts, at), key[at], look)
    at = np.flatnonzero(parts.door)
    colour[at] = _door(_some(parts, at), tint[at], look)
    if look.snowing > 0:
        colour = mix(colour, np.array(look.snow), sill * above * look.snowing)
    grime = 1 - 0.18 * (1 - step(v, 0.0, 1.6)) * house
    return (colour * grime[:, None]).astype(np.float32), glow
