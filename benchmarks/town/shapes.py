"""Convex solids of the town, and the houses, trees, lamps and cars that are made of them.

A face has a frame: an origin (its lowest, leftmost corner as seen from outside), u to the right, v up the
face, and its extent in metres along both. Textures, windows and doors are laid out in these coordinates.
"""

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_FLAT: Array = np.zeros(3)


class Material(IntEnum):
    """Material of a face (finer than its class)."""

    GROUND, FACADE, ROOF, TRIM, FOLIAGE, TRUNK, POST, LANTERN, PAINT, GLASS, TYRE = range(11)


class Finish(NamedTuple):
    """Parameters of a face. Whole numbers that painters read; their meaning depends on the material."""

    material: Material
    style: int = 0
    """Facade: 0 brick, 1 plaster, 2 clapboard, 3 timber, 4 stone. Roof: 0 tiles, 1 flat."""
    tint: int = 0
    """Index of the palette's colour for this material."""
    columns: int = 0
    """Facade: windows side by side; 0 = a blank wall."""
    storeys: int = 0
    """Facade: rows of windows; 0 = a gable, with a single small window if it has columns."""
    door: int = -1
    """Facade: column of the door, -1 = none."""
    shutters: int = 0
    """Facade: 1 = windows have shutters."""


class Face(NamedTuple):
    """One side of a solid: its finish, its frame, and for round ones what their normals follow from."""

    finish: Finish
    origin: Array
    u: Array
    v: Array
    extent: Array
    centre: Array = _FLAT
    curve: Array = _FLAT
    """The normal at x points along curve · (x - centre); zeros on flat faces, whose normal is u × v."""


class Polyhedron(NamedTuple):
    """P half-spaces normals [P 3] · x <= offsets [P], bounded by the box low, high."""

    normals: Array
    offsets: Array
    faces: tuple[Face, ...]
    low: Array
    high: Array


class Ellipsoid(NamedTuple):
    """Axis-aligned ellipsoid."""

    centre: Array
    radii: Array
    faces: tuple[Face, ...]
    low: Array
    high: Array


class Cylinder(NamedTuple):
    """Vertical cylinder between low and high; open at both ends, which are hidden in the ground and in other
    solids.
    """

    centre: Array
    radius: float
    faces: tuple[Face, ...]
    low: Array
    high: Array


Shape = Polyhedron | Ellipsoid | Cylinder


def _face(finish: Finish, normal: Array, corners: Array) -> Face:
    up = np.array([0.0, 0.0, 1.0])
    u = np.array([1.0, 0.0, 0.0]) if abs(normal[2]) > 0.999 else np.cross(up, normal)
    u = u / np.linalg.norm(u)
    v = np.cross(normal, u)
    a = corners @ u
    b = corners @ v
    c = float(corners[0] @ normal)
    origin = u * a.min() + v * b.min() + normal * c
    return Face(finish, origin, u, v, np.array([np.ptp(a), np.ptp(b)]))


def extrude(
    profile: Sequence[tuple[float, float]], axis: int, start: float, stop: float, finishes: Sequence[Finish]
) -> Polyhedron:
    """A convex profile swept along an axis.

    Args:
        profile: K corners, counter-clockwise, in the two other axes in ascending order.
        axis: 0, 1 or 2.
        start: where the sweep begins along the axis.
        stop: where it ends.
        finishes: K + 2: one per side (from corner k to k + 1), then the cap at `start`, then the one at
        `stop`.
    """
    across = [i for i in range(3) if i != axis]
    corner = np.asarray(profile, dtype=np.float64)
    rings = np.empty((2, len(corner), 3))
    rings[:, :, across] = corner
    rings[0, :, axis], rings[1, :, axis] = start, stop
    normals = []
    faces = []
    for k in range(len(corner)):
        m = (k + 1) % len(corner)
        edge = corner[m] - corner[k]
        normal = np.zeros(3)
        normal[across] = np.array([edge[1], -edge[0]]) / np.hypot(*edge)
        normals.append(normal)
        faces.append(_face(finishes[k], normal, rings[:, [k, m]].reshape(-1, 3)))
    for end in (0, 1):
        normal = np.zeros(3)
        normal[axis] = 2.0 * end - 1.0
        normals.append(normal)
        faces.append(_face(finishes[len(corner) + end], normal, rings[end]))
    every = rings.reshape(-1, 3)
    return _polyhedron(normals, faces, every.min(0), every.max(0))


def _polyhedron(normals: list[Array], faces: list[Face], low: Array, high: Array) -> Polyhedron:
    offsets = np.array([face.origin @ normal for face, normal in zip(faces, normals, strict=True)])
    return Polyhedron(np.stack(normals), offsets, tuple(faces), low, high)


def box(low: Sequence[float], high: Sequence[float], finishes: Sequence[Finish]) -> Polyhedron:
    """An axis-aligned box; finishes of the sides facing -y, +x, +y, -x, then bottom and top."""
    profile = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    return extrude(profile, 2, low[2], high[2], finishes)


def pyramid(low: Sequence[float], high: Sequence[float], finish: Finish) -> Polyhedron:
    """Four slopes over the base of the box low, high, meeting above its middle at the box's height."""
    base = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    ring = np.column_stack([base, np.full(4, low[2])])
    apex = np.array([*base.mean(0), high[2]])
    normals = []
    faces = []
    for k in range(4):
        corners = np.stack([ring[k], ring[(k + 1) % 4], apex])
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        normals.append(normal)
        faces.append(_face(finish, normal, corners))
    normals.append(np.array([0.0, 0.0, -1.0]))
    faces.append(_face(finish, normals[-1], ring))
    return _polyhedron(normals, faces, np.asarray(low, float), np.asarray(high, float))


def _round(finish: Finish, low: Array, high: Array, curve: Array) -> tuple[Face, ...]:
    x, _, z = np.eye(3)
    return (Face(finish, low, x, z, (high - low)[[0, 2]], (low + high) / 2, curve),)


def ellipsoid(centre: Sequence[float], radii: Sequence[float], finish: Finish) -> Ellipsoid:
    """An ellipsoid of one finish."""
    middle = np.asarray(centre, float)
    radius = np.asarray(radii, float)
    low = middle - radius
    high = middle + radius
    return Ellipsoid(middle, radius, _round(finish, low, high, radius**-2), low, high)


def cylinder(x: float, y: float, low: float, high: float, radius: float, finish: Finish) -> Cylinder:
    """A post of one finish at (x, y) from height low to high."""
    bottom = np.array([x - radius, y - radius, low])
    top = np.array([x + radius, y + radius, high])
    return Cylinder(
        np.array([x, y]), radius, _round(finish, bottom, top, np.array([1.0, 1.0, 0.0])), bottom, top
    )


PLINTH = 0.4
STOREY = 2.8
"""Metres of wall below the first floor, and per floor."""
_EAVE = 0.4
_HIDDEN = Finish(Material.TRIM)


class Lot(NamedTuple):
    """Place of a house: x from start to stop, its front at |y| = front on one side (-1 or 1) of the
    street.
    """

    start: float
    stop: float
    front: float
    depth: float
    side: int


def _wall(wall: Finish, width: float, door: bool) -> Finish:
    columns = max(1, round(width / 2.7))
    return wall._replace(columns=columns, door=columns // 2 if door else -1)


def _gabled(
    lot: Lot, low: float, high: float, eave: float, rise: float, along: bool, roof: Finish, wall: Finish
) -> Shape:
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
    width = lot.stop - lot.start
    height = PLINTH + STOREY * storeys
    face = _wall(wall, width, True)
    flank = _wall(wall, lot.depth, False)
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
            box(
                (lot.start - over, low - over, height - 0.1),
                (lot.stop + over, high + over, height + 0.3),
                [*sides, roof],
            )
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
    lot: Lot,
    low: float,
    high: float,
    height: float,
    rise: float,
    wall: Finish,
    roof: Finish,
    rng: np.random.Generator,
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
        base = height + 0.15
        eave = height + 0.45 * rise + 0.35
        ridge = height + 0.45 * rise + 1.15
        blank = face._replace(columns=0)
        shapes.append(
            box((x - 0.7, y[0], base), (x + 0.7, y[1], eave), [face, blank, face, blank, _HIDDEN, _HIDDEN])
        )
        profile = [(x - 0.95, eave - 0.06), (x + 0.95, eave - 0.06), (x, ridge)]
        reach = (y[0] - 0.2, y[1]) if lot.side > 0 else (y[0], y[1] + 0.2)
        shapes.append(extrude(profile, 1, *reach, [_HIDDEN, roof, roof, blank, blank]))
    return shapes


def church(x: float, rng: np.random.Generator) -> list[Shape]:
    """A church that closes the street: a tower with a spire before a nave, its front at x."""
    stone = Finish(Material.FACADE, style=4, tint=int(rng.integers(0, 8)))
    slate = Finish(Material.ROOF, style=0, tint=3)
    y = float(rng.uniform(-0.6, 0.6))
    half = 2.6
    tall = float(rng.uniform(12.0, 15.0))
    front = stone._replace(columns=1, storeys=4, door=0)
    flank = stone._replace(columns=1, storeys=4)
    nave = stone._replace(columns=3, storeys=1)
    tower = box(
        (x, y - half, 0), (x + 2 * half, y + half, tall), [flank, flank, flank, front, _HIDDEN, _HIDDEN]
    )
    spire = pyramid(
        (x - 0.25, y - half - 0.25, tall - 0.1), (x + 2 * half + 0.25, y + half + 0.25, tall + 7.0), slate
    )
    wide = 5.6
    long = 13.0
    high = 5.5
    hall = box(
        (x + 3, y - wide, 0), (x + 3 + long, y + wide, high), [nave, nave, nave, nave, _HIDDEN, _HIDDEN]
    )
    profile = [(y - wide - 0.4, high - 0.1), (y + wide + 0.4, high - 0.1), (y, high + 5.0)]
    blank = stone._replace(columns=0)
    cover: Polyhedron = extrude(profile, 0, x + 2.7, x + 3.3 + long, [_HIDDEN, slate, slate, blank, blank])
    return [tower, spire, hall, cover]


LANTERN = 4.0
"""Height of the light of a lamp."""


def tree(x: float, y: float, size: float, rng: np.random.Generator) -> list[Shape]:
    """A round crown of several ellipsoids, about 2 + 2 size metres high, or a slim poplar, 5.6 + 2 size
    high.
    """
    leaf = Finish(Material.FOLIAGE, tint=int(rng.integers(0, 6)))
    bark = Finish(Material.TRUNK)
    if rng.random() < 0.2:
        tall = 2.3 + size
        return [
            cylinder(x, y, 0.0, 1.6, 0.14, bark),
            ellipsoid((x, y, 1.0 + tall), (0.55 * size, 0.55 * size, tall), leaf),
        ]
    stem = 2.1 + 0.4 * size
    shapes: list[Shape] = [
        cylinder(x, y, 0.0, stem + 0.8, 0.11 + 0.05 * size, bark),
        ellipsoid((x, y, stem + 0.95 * size), (0.85 * size, 0.85 * size, 0.95 * size), leaf),
    ]
    turn = float(rng.uniform(0, 2 * math.pi))
    count = 7
    for k in range(count):
        angle = turn + 2.4 * k
        away = float(rng.uniform(0.5, 0.75)) * size
        up = (0.3 + 1.1 * k / count) * size
        radius = float(rng.uniform(0.42, 0.62)) * size
        centre = (x + away * math.cos(angle), y + away * math.sin(angle), stem + up)
        shapes.append(ellipsoid(centre, (radius, radius, 0.85 * radius), leaf))
    return shapes


def bush(x: float, y: float, size: float, rng: np.random.Generator) -> list[Shape]:
    """A shrub resting on the ground."""
    leaf = Finish(Material.FOLIAGE, tint=int(rng.integers(0, 6)))
    return [ellipsoid((x, y, 0.35 * size), (size, size * 0.8, 0.75 * size), leaf)]


def hedge(low: tuple[float, float], high: tuple[float, float], height: float) -> Shape:
    """A clipped hedge."""
    return box((*low, 0.0), (*high, height), [Finish(Material.FOLIAGE, tint=6)] * 6)


def forest(x: float, y: float, size: float, rng: np.random.Generator) -> Shape:
    """One crown of the wood that hides the horizon."""
    leaf = Finish(Material.FOLIAGE, style=1, tint=int(rng.integers(0, 6)))
    tall = size * float(rng.uniform(1.3, 1.9))
    return ellipsoid((x, y, 0.25 * tall), (size, size, tall), leaf)


def lamp(x: float, y: float) -> list[Shape]:
    """A street lamp: post, lantern and cap."""
    post = Finish(Material.POST)
    return [
        cylinder(x, y, 0.0, 0.5, 0.13, post),
        cylinder(x, y, 0.0, LANTERN - 0.2, 0.06, post),
        ellipsoid((x, y, LANTERN), (0.24, 0.24, 0.33), Finish(Material.LANTERN)),
        ellipsoid((x, y, LANTERN + 0.3), (0.3, 0.3, 0.12), post),
    ]


def car(x: float, y: float, axis: int, rng: np.random.Generator) -> list[Shape]:
    """A parked car, 4.2 m long, along x (axis 0) or along y (axis 1); its middle at (x, y)."""
    paint = Finish(Material.PAINT, tint=int(rng.integers(0, 6)))
    glass = Finish(Material.GLASS, tint=paint.tint)
    pane = glass._replace(style=1)
    middle, side = (x, y) if axis == 0 else (y, x)
    facing = 1 if rng.random() < 0.5 else -1

    def profile(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
        placed = [(middle + facing * a, b) for a, b in points]
        return placed if facing > 0 else placed[::-1]

    body = profile(
        [(-2.05, 0.28), (2.05, 0.28), (2.1, 0.62), (1.95, 0.8), (0.95, 0.98), (-1.95, 0.98), (-2.1, 0.7)]
    )
    cabin = profile([(-1.75, 0.95), (1.05, 0.95), (0.35, 1.5), (-1.15, 1.5)])
    top = 2 if facing > 0 else 0
    cover = [glass, glass, glass, glass]
    cover[top] = paint
    sweep = 1 - axis
    shapes: list[Shape] = [
        extrude(body, sweep, side - 0.85, side + 0.85, [paint] * 9),
        extrude(cabin, sweep, side - 0.72, side + 0.72, [*cover, pane, pane]),
    ]
    for along in (-1.3, 1.3):
        for beside in (-0.78, 0.78):
            a = middle + along
            b = side + beside
            centre, radii = (
                ((a, b, 0.33), (0.34, 0.13, 0.34)) if axis == 0 else ((b, a, 0.33), (0.13, 0.34, 0.34))
            )
            shapes.append(ellipsoid(centre, radii, Finish(Material.TYRE)))
    return shapes
