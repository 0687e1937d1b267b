"""Houses and the church, as lists of solids."""

from typing import NamedTuple

import numpy as np

from .shapes import Finish, Material, Polyhedron, Shape, box, extrude, pyramid

__all__ = ["PLINTH", "STOREY", "Lot", "church", "house"]

PLINTH, STOREY = 0.4, 2.8
"""Metres of wall below the first floor, and per floor."""
_EAVE = 0.4
_HIDDEN = Finish(Material.TRIM)


class Lot(NamedTuple):
    """Where a house stands: x from start to stop, its front at |y| = front on one side (-1 or 1) of the street."""

    start: float
    stop: float
    front: float
    depth: float
    side: int


def _wall(wall: Finish, width: float, door: bool) -> Finish:
    columns = max(1, round(width / 2.7))
    return wall._replace(columns=columns, door=columns // 2 if door else -1)


def _gabled(lot: Lot, low: float, high: float, eave: float, rise: float, along: bool, roof: Finish, wall: Finish) -> Shape:
    gable = wall._replace(columns=1, storeys=0, door=-1, shutters=0)
    x = (lot.start - _EAVE, lot.stop + _EAVE)
    y = (low - _EAVE, high + _EAVE)
    across, sweep, axis = (y, x, 0) if along else (x, y, 1)
    profile = [(across[0], eave), (across[1], eave), (sum(across) / 2, eave + rise)]
    return extrude(profile, axis, *sweep, [_HIDDEN, roof, roof, gable, gable])


def house(lot: Lot, style: int, rng: np.random.Generator) -> list[Shape]:
    """A house of one to three floors under a gabled or a flat roof; the style is that of its walls."""
    storeys = 1 + int(rng.random() < 0.75) + int(rng.random() < 0.3)
    wall = Finish(
        Material.FACADE,
        style=style,
        tint=int(rng.integers(0, 8)),
        storeys=storeys,
        shutters=int(rng.random() < 0.45),
    )
    low, high = sorted((lot.side * lot.front, lot.side * (lot.front + lot.depth)))
    width, height = lot.stop - lot.start, PLINTH + STOREY * storeys
    face, flank = _wall(wall, width, True), _wall(wall, lot.depth, False)
    back = face._replace(door=-1)
    ends = (face, back) if lot.side > 0 else (back, face)
    shapes: list[Shape] = [
        box((lot.start, low, 0), (lot.stop, high, height), [ends[0], flank, ends[1], flank, _HIDDEN, _HIDDEN])
    ]
    if rng.random() < 0.2:
        roof = Finish(Material.ROOF, style=1, tint=int(rng.integers(0, 4)))
        sides = [_HIDDEN] * 5
        over = 0.2
        shapes.append(
            box((lot.start - over, low - over, height - 0.1), (lot.stop + over, high + over, height + 0.3), [*sides, roof])
        )
        return shapes
    roof = Finish(Material.ROOF, style=0, tint=int(rng.integers(0, 4)))
    along = bool(rng.random() < 0.55)
    span = lot.depth if along else width
    rise = float(rng.uniform(0.36, 0.52)) * span
    shapes.append(_gabled(lot, low, high, height - 0.12, rise, along, roof, wall))
    if along:
        chimney = Finish(Material.FACADE, style=0, tint=0)
        x = lot.start + float(rng.uniform(0.15, 0.85)) * (width - 0.8)
        y = (low + high) / 2 - lot.side * 0.9
        top = height + rise + 0.7
        shapes.append(box((x, y - 0.35, height), (x + 0.7, y + 0.35, top), [chimney] * 4 + [_HIDDEN] * 2))
        shapes += _dormers(lot, low, high, height, rise, wall, roof, rng)
    return shapes


def _dormers(
    lot: Lot, low: float, high: float, height: float, rise: float, wall: Finish, roof: Finish, rng: np.random.Generator
) -> list[Shape]:
    if rng.random() < 0.4:
        return []
    front = low if lot.side > 0 else high
    y = sorted((front + lot.side * 0.7, front + lot.side * 0.45 * (high - low)))
    face = wall._replace(columns=1, storeys=0, door=-1, shutters=0)
    shapes: list[Shape] = []
    count = max(1, int((lot.stop - lot.start) / 3.4))
    for k in range(count):
        x = lot.start + (k + 0.5) * (lot.stop - lot.start) / count
        base, eave, ridge = height + 0.15, height + 0.45 * rise + 0.35, height + 0.45 * rise + 1.15
        blank = face._replace(columns=0)
        shapes.append(box((x - 0.7, y[0], base), (x + 0.7, y[1], eave), [face, blank, face, blank, _HIDDEN, _HIDDEN]))
        profile = [(x - 0.95, eave - 0.06), (x + 0.95, eave - 0.06), (x, ridge)]
        reach = (y[0] - 0.2, y[1]) if lot.side > 0 else (y[0], y[1] + 0.2)
        shapes.append(extrude(profile, 1, *reach, [_HIDDEN, roof, roof, blank, blank]))
    return shapes


def church(x: float, rng: np.random.Generator) -> list[Shape]:
    """A church that closes the street: a tower with a spire before a nave, its front at x."""
    stone = Finish(Material.FACADE, style=4, tint=int(rng.integers(0, 8)))
    slate = Finish(Material.ROOF, style=0, tint=3)
    y, half, tall = float(rng.uniform(-0.6, 0.6)), 2.6, float(rng.uniform(12.0, 15.0))
    front = stone._replace(columns=1, storeys=4, door=0)
    flank = stone._replace(columns=1, storeys=4)
    nave = stone._replace(columns=3, storeys=1)
    tower = box((x, y - half, 0), (x + 2 * half, y + half, tall), [flank, flank, flank, front, _HIDDEN, _HIDDEN])
    spire = pyramid((x - 0.25, y - half - 0.25, tall - 0.1), (x + 2 * half + 0.25, y + half + 0.25, tall + 7.0), slate)
    wide, long, high = 5.6, 13.0, 5.5
    hall = box((x + 3, y - wide, 0), (x + 3 + long, y + wide, high), [nave, nave, nave, nave, _HIDDEN, _HIDDEN])
    profile = [(y - wide - 0.4, high - 0.1), (y + wide + 0.4, high - 0.1), (y, high + 5.0)]
    blank = stone._replace(columns=0)
    cover: Polyhedron = extrude(profile, 0, x + 2.7, x + 3.3 + long, [_HIDDEN, slate, slate, blank, blank])
    return [tower, spire, hall, cover]
