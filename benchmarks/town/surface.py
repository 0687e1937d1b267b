"""Surface points of the town: classes, coordinates on a face, parts of a facade; and noise and patterns to
paint them with.

Noise and patterns are deterministic functions of coordinates in metres, with values in [0, 1] unless said
otherwise.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .layout import END, ROAD_HALF, SQUARE_HALF, WALK_HALF, FaceTable, Town
from .shapes import PLINTH, Material

SKY, LAWN, ROAD, SIDEWALK, FACADE, ROOF, FOLIAGE, TRUNK, WINDOW, LAMP, DOOR, CAR = range(12)

CLASSES = (
    "sky",
    "lawn",
    "road",
    "sidewalk",
    "facade",
    "roof",
    "foliage",
    "trunk",
    "window",
    "lamp",
    "door",
    "car",
)
"""Names by id."""


Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_STONE = 4
_CLASS = {
    Material.FACADE: FACADE,
    Material.ROOF: ROOF,
    Material.TRIM: ROOF,
    Material.FOLIAGE: FOLIAGE,
    Material.TRUNK: TRUNK,
    Material.POST: LAMP,
    Material.LANTERN: LAMP,
    Material.PAINT: CAR,
    Material.GLASS: CAR,
    Material.TYRE: CAR,
}
"""Class of each material; the ground's depends on the place."""


class Parts(NamedTuple):
    """Places of N points on a facade."""

    window: Mask
    """Frame included."""
    door: Mask
    shutter: Mask
    across: Array
    """Metres from the middle of the window's or the door's column."""
    up: Array
    """Metres above the foot of the opening."""
    half: Array
    """Half the width of the opening."""
    tall: Array
    """Its height."""
    column: NDArray[np.int64]
    storey: NDArray[np.int64]


def on_face(faces: FaceTable, face: NDArray[np.integer], points: Array) -> tuple[Array, Array]:
    """Coordinates u, v in metres of points [N 3] on their faces [N]."""
    off = points - faces.origin[face]
    u = faces.u[face]
    v = faces.v[face]
    return (off * u).sum(1), (off * v).sum(1)


def facade_parts(faces: FaceTable, face: NDArray[np.integer], u: Array, v: Array) -> Parts:
    """The openings of walls: rows of windows, a door, or the small window of a gable or a dormer."""
    wide, high = faces.extent[face].T
    columns = faces.columns[face]
    storeys = faces.storeys[face]
    stone = faces.style[face] == _STONE
    gable = storeys == 0
    pitch = wide / np.maximum(columns, 1)
    column = np.clip(np.floor(u / pitch), 0, np.maximum(columns, 1) - 1).astype(np.int64)
    across = u - (column + 0.5) * pitch
    floor = (high - PLINTH) / np.maximum(storeys, 1)
    storey = np.where(gable, 0, np.floor((v - PLINTH) / floor)).astype(np.int64)
    dormer = gable & (wide < 2.0)
    foot = np.where(gable, np.where(dormer, 0.48, 0.26) * high, PLINTH + (storey + 0.28) * floor)
    tall = np.where(gable, np.where(dormer, 0.44, 0.30) * high, 0.53 * floor)
    half = np.where(gable, 0.45, np.where(stone, 0.42, 0.56))
    up = v - foot
    within = (columns > 0) & (storey >= 0) & (storey < np.maximum(storeys, 1))
    entry = (column == faces.door[face]) & (storey <= 0) & ~gable
    door = entry & (columns > 0) & (np.abs(across) < 0.62) & (v < 2.35)
    inside = (np.abs(across) < half) & (up > 0) & (up < tall)
    # Church windows end in a half circle.
    arch = ~stone | (up < tall - half) | (across**2 + (up - tall + half) ** 2 < half**2)
    window = within & inside & arch & ~entry
    beside = (np.abs(across) >= half + 0.02) & (np.abs(across) < half + 0.42) & (up > 0) & (up < tall)
    shutter = within & beside & (faces.shutters[face] == 1) & ~gable & ~(entry & (v < 2.35)) & ~stone & ~entry
    return Parts(
        window, door, shutter, across, np.where(door, v, up), half, np.where(door, 2.35, tall), column, storey
    )


def ground_class(points: Array) -> NDArray[np.uint8]:
    """Road, sidewalk (the square too) or lawn, by place."""
    x = points[:, 0]
    y = np.abs(points[:, 1])
    paved = (y < WALK_HALF) | ((x > END) & (x < END + 22.0) & (y < SQUARE_HALF))
    road = (y < ROAD_HALF) & (x < END)
    return np.where(road, ROAD, np.where(paved, SIDEWALK, LAWN)).astype(np.uint8)


def labels(town: Town, face: NDArray[np.integer], points: Array) -> NDArray[np.uint8]:
    """Classes of points [N 3] on faces [N]; face -1 is the sky."""
    table = np.full(len(Material), SKY, dtype=np.uint8)
    for material, label in _CLASS.items():
        table[material] = label
    kind = np.where(face < 0, -1, town.faces.material[face])
    result = np.where(kind < 0, np.uint8(SKY), table[kind])
    ground = np.flatnonzero(kind == Material.GROUND)
    result[ground] = ground_class(points[ground])
    wall = np.flatnonzero(kind == Material.FACADE)
    u, v = on_face(town.faces, face[wall], points[wall])
    parts = facade_parts(town.faces, face[wall], u, v)
    result[wall[parts.window]] = WINDOW
    result[wall[parts.door]] = DOOR
    return result


Values = NDArray[np.float32]
_PRIMES = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)


def hashed(seed: int, *cell: NDArray[np.int64]) -> Values:
    """A uniform number per integer cell: up to three coordinates."""
    h = np.full(
        np.broadcast_shapes(*(c.shape for c in cell)),
        (seed * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF,
        np.uint32,
    )
    for c, prime in zip(cell, _PRIMES, strict=False):
        h = (h ^ c.astype(np.uint32)) * np.uint32(prime)
        h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(13)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def _split(x: NDArray[np.floating]) -> tuple[NDArray[np.int64], Values]:
    whole = np.floor(x)
    part = (x - whole).astype(np.float32)
    return whole.astype(np.int64), np.asarray(part * part * (3 - 2 * part), np.float32)


def noise2(x: NDArray[np.floating], y: NDArray[np.floating], seed: int) -> Values:
    """Smooth value noise with unit cells."""
    (i, a) = _split(x)
    (j, b) = _split(y)
    low = hashed(seed, i, j) * (1 - a) + hashed(seed, i + 1, j) * a
    high = hashed(seed, i, j + 1) * (1 - a) + hashed(seed, i + 1, j + 1) * a
    return np.asarray(low * (1 - b) + high * b, np.float32)


def noise3(x: NDArray[np.floating], y: NDArray[np.floating], z: NDArray[np.floating], seed: int) -> Values:
    """Smooth value noise with unit cells in space."""
    (i, a) = _split(x)
    (j, b) = _split(y)
    (k, c) = _split(z)

    def plane(m: NDArray[np.int64]) -> Values:
        low = hashed(seed, i, j, m) * (1 - a) + hashed(seed, i + 1, j, m) * a
        high = hashed(seed, i, j + 1, m) * (1 - a) + hashed(seed, i + 1, j + 1, m) * a
        return np.asarray(low * (1 - b) + high * b, np.float32)

    return np.asarray(plane(k) * (1 - c) + plane(k + 1) * c, np.float32)


def fractal2(x: NDArray[np.floating], y: NDArray[np.floating], seed: int) -> Values:
    """Two octaves of noise2."""
    return noise2(x, y, seed) * np.float32(0.65) + noise2(2.3 * x, 2.3 * y, seed + 1) * np.float32(0.35)


def fractal3(p: NDArray[np.floating], rate: float, seed: int) -> Values:
    """Two octaves of noise3 at points [N 3], with `rate` cells per metre."""
    x, y, z = p.T * rate
    return noise3(x, y, z, seed) * np.float32(0.65) + noise3(
        2.3 * x, 2.3 * y, 2.3 * z, seed + 1
    ) * np.float32(0.35)


def step(x: NDArray[np.floating], low: float, high: float) -> Values:
    """Smooth rise from 0 at low to 1 at high."""
    s = np.clip((x - low) / (high - low), 0.0, 1.0).astype(np.float32)
    return np.asarray(s * s * (3 - 2 * s), np.float32)


def band(x: NDArray[np.floating], half: float | NDArray[np.floating], soft: float = 0.02) -> Values:
    """1 where |x| < half, falling to 0 within `soft` metres on both sides of the edge."""
    return np.asarray(np.clip((half - np.abs(x)) / (2 * soft) + 0.5, 0.0, 1.0), np.float32)


def cells(
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    width: float,
    height: float,
    joint: float,
    shift: float,
    seed: int,
) -> tuple[Values, Values]:
    """Bricks, slabs, tiles: a number per cell, and 1 in the joints. Every other row moves by `shift` of a
    cell.
    """
    row = np.floor(v / height)
    column = u / width + shift * (row % 2)
    across = (column - np.floor(column) - 0.5) * width
    along = (v / height - row - 0.5) * height
    inside = band(across, width / 2 - joint) * band(along, height / 2 - joint)
    return hashed(seed, np.floor(column).astype(np.int64), row.astype(np.int64)), 1 - inside


def mix(a: NDArray[np.floating], b: NDArray[np.floating], share: NDArray[np.floating]) -> Values:
    """Colours a and b ([3] or [N 3]) mixed by share [N] of b: [N 3]."""
    s = share[:, None].astype(np.float32)
    return np.asarray(a * (1 - s) + b * s, np.float32)
