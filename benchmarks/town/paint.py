"""Colour (sRGB) and emitted light (linear) of surface points, by material: facades, roofs, foliage, cars,
ground.
"""

import numpy as np
from numpy.typing import NDArray

from .layout import CROSSING, END, KERB, ROAD_HALF, FaceTable, Town
from .palettes import Palette
from .shapes import PLINTH, STOREY, Material
from .surface import (
    LAWN,
    ROAD,
    SIDEWALK,
    Parts,
    band,
    cells,
    facade_parts,
    fractal2,
    fractal3,
    ground_class,
    hashed,
    mix,
    noise2,
    noise3,
    on_face,
    step,
)

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
    x = points[:, 0]
    y = points[:, 1]
    kind = ground_class(points)
    colour = np.empty((len(points), 3), dtype=np.float32)
    for label, painter in ((LAWN, _lawn), (ROAD, _road), (SIDEWALK, _sidewalk)):
        at = np.flatnonzero(kind == label)
        colour[at] = painter(x[at], y[at], look)
    if look.littering > 0:
        share = np.array([0.0, 1.0, 0.3, 0.6], dtype=np.float32)[kind] * np.float32(look.littering)
        fallen = step(
            0.6 * noise2(6.5 * x, 6.5 * y, 41) + 0.4 * noise2(0.7 * x, 0.7 * y, 43) + 0.72 * share, 0.72, 0.82
        )
        hue = mix(np.array(look.litter) * 0.75, np.array(look.litter) * 1.25, noise2(6 * x, 6 * y, 45))
        colour = mix(colour, hue, fallen * 0.85)
    if look.snowing > 0:
        share = np.array([0.0, 1.0, 0.36, 0.72], dtype=np.float32)[kind] * np.float32(look.snowing)
        track = band(np.abs(y) - 1.05, 0.35, 0.25) + band(np.abs(y) - 2.55, 0.35, 0.25)
        share -= np.where(kind == ROAD, 0.22 * track, 0).astype(np.float32)
        lies = step(
            (0.6 * fractal2(0.6 * x, 1.4 * y, 51) + 0.4 * noise2(4 * x, 4 * y, 55)) * 0.7 + share, 0.55, 0.82
        )
        tone = 0.94 + 0.06 * fractal2(1.6 * x, 1.6 * y, 53)
        colour = mix(colour, np.array(look.snow) * tone[:, None], lies * 0.95)
    return colour


_BRICK, _PLASTER, _CLAPBOARD, _TIMBER, _STONE = range(5)


def _choose(colours: tuple[tuple[float, float, float], ...], index: NDArray[np.integer]) -> Colours:
    return np.asarray(np.array(colours, dtype=np.float32)[index % len(colours)])


def _some(parts: Parts, at: NDArray[np.int64]) -> Parts:
    return Parts._make(each[at] for each in parts)


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
    posts = band(np.abs(parts.across) - pitch / 2, 0.12) + band(
        np.abs(parts.across) - parts.half - 0.09, 0.08
    )
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
    side = np.abs(parts.across)
    up = parts.up
    panel = band(side - 0.25, 0.16) * np.maximum(band(up - 0.55, 0.32), band(up - 1.3, 0.28))
    light = band(side, 0.40) * band(up - 1.92, 0.16)
    colour = _choose(look.doors, tint) * (1 - 0.32 * panel)[:, None]
    colour = mix(colour, np.array(look.glass[1]), light)
    frame = np.maximum(band(side - 0.62, 0.1), band(up - 2.35, 0.1))
    return mix(colour, np.array(look.trim), frame)


def paint_walls(
    faces: FaceTable, face: NDArray[np.integer], points: Array, look: Palette
) -> tuple[Colours, Colours]:
    """Colours and emitted light, [N 3] each, of points on facades."""
    u, v = on_face(faces, face, points)
    parts = facade_parts(faces, face, u, v)
    tint = faces.tint[face]
    style = faces.style[face]
    wide = faces.extent[face][:, 0]
    columns = faces.columns[face]
    storeys = faces.storeys[face]
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
    lintel = (
        band(parts.up - parts.tall - 0.09, 0.09) * band(parts.across, parts.half + 0.1) * (style != _TIMBER)
    )
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


_WOOD_RATE = 1.2
_LEAF_RATE = 4.2
"""Noise cells per metre in the distant wood and in near crowns."""


def foliage_normals(points: Array, normals: Colours, distant: NDArray[np.bool_]) -> Colours:
    """Normals [N 3] roughened by leaves; a function of the point alone."""
    p = points * np.where(distant, 0.9, 3.4)[:, None]
    x, y, z = p.T
    rough = np.stack([noise3(x, y, z, 81 + i) for i in range(3)], 1) - np.float32(0.5)
    bent = normals + np.float32(1.7) * rough
    return np.asarray(bent / np.linalg.norm(bent, axis=1, keepdims=True), np.float32)


def _foliage(
    town: Town, face: NDArray[np.integer], points: Array, normals: Colours, look: Palette
) -> Colours:
    pairs = np.array(look.leaves, dtype=np.float32)[town.faces.tint[face]]
    distant = town.faces.style[face] == 1
    rate = np.where(distant, _WOOD_RATE, _LEAF_RATE)[:, None]
    fine = fractal3(points * rate, 1.0, 91)
    broad = fractal3(points * rate * 0.3, 1.0, 95)
    colour = mix(pairs[:, 0], pairs[:, 1], step(0.6 * fine + 0.4 * broad, 0.15, 0.85))
    colour = colour * (0.70 + 0.30 * step(fine, 0.15, 0.5))[:, None]
    return _snowed(colour, fine, normals, look, 0.85)


def _snowed(
    colour: Colours, noise: NDArray[np.float32], normals: Colours, look: Palette, most: float
) -> Colours:
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
    frame = np.where(
        side,
        np.maximum(band(u - 0.52 * wide, 0.05), 1 - step(high - v, 0.04, 0.1)),
        1 - step(edge, 0.04, 0.1),
    )
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


def paint(
    town: Town, face: NDArray[np.integer], points: Array, normals: Colours, look: Palette
) -> tuple[Colours, Colours]:
    """Colours (sRGB) and emitted light (linear), [N 3] each, of points on faces [N], none of them the sky."""
    colour = np.zeros((len(points), 3), dtype=np.float32)
    glow = np.zeros_like(colour)
    kinds = town.faces.material[face]
    for kind in Material:
        at = np.flatnonzero(kinds == kind)
        if len(at) == 0:
            continue
        f = face[at]
        p = points[at]
        n = normals[at]
        if kind == Material.GROUND:
            colour[at] = paint_ground(p, look)
        elif kind == Material.FACADE:
            colour[at], glow[at] = paint_walls(town.faces, f, p, look)
        elif kind == Material.ROOF:
            colour[at] = _roof(town, f, p, n, look)
        elif kind == Material.FOLIAGE:
            colour[at] = _foliage(town, f, p, n, look)
        elif kind in (Material.PAINT, Material.GLASS, Material.TYRE):
            colour[at] = _snowed(
                _car(kind, town, f, p, look), np.full(len(at), 0.5, np.float32), n, look, 0.9
            )
        else:
            colour[at] = _plain(kind, p, look)
        if kind == Material.LANTERN:
            glow[at] = np.array(look.light) * min(look.lamps, 3.0)
    return np.clip(colour, 0.0, 1.0), glow
