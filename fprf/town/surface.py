"""What a surface point is: its coordinates on its face, the parts of a facade, and its class."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .buildings import PLINTH
from .classes import CAR, DOOR, FACADE, FOLIAGE, LAMP, LAWN, ROAD, ROOF, SIDEWALK, SKY, TRUNK, WINDOW
from .layout import END, ROAD_HALF, SQUARE_HALF, WALK_HALF, FaceTable, Town
from .shapes import Material

__all__ = ["Parts", "facade_parts", "ground_class", "labels", "on_face"]

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
    """Where on a facade N points lie."""

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
    u, v = faces.u[face], faces.v[face]
    return (off * u).sum(1), (off * v).sum(1)


def facade_parts(faces: FaceTable, face: NDArray[np.integer], u: Array, v: Array) -> Parts:
    """The openings of walls: rows of windows, a door, or the small window of a gable or a dormer."""
    wide, high = faces.extent[face].T
    columns, storeys = faces.columns[face], faces.storeys[face]
    stone, gable = faces.style[face] == _STONE, storeys == 0
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
    return Parts(window, door, shutter, across, np.where(door, v, up), half, np.where(door, 2.35, tall), column, storey)


def ground_class(points: Array) -> NDArray[np.uint8]:
    """Road, sidewalk (the square too) or lawn, by place."""
    x, y = points[:, 0], np.abs(points[:, 1])
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
