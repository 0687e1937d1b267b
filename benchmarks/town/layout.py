"""A town from a seed: which solids stand where.

The street runs along x from -8 to 42 m and ends in a square before a church; houses, front gardens, trees and
lamps line it on both sides (y < 0 and y > 0); a wood all around hides the horizon, so that every ray ends
within about 80 m. A longer street begins further back.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .shapes import (
    LANTERN,
    Face,
    Finish,
    Lot,
    Material,
    Shape,
    bush,
    car,
    church,
    forest,
    hedge,
    house,
    lamp,
    tree,
)

ROAD_HALF = 3.4
WALK_HALF = 5.4
KERB = 0.22
"""Half widths of the road and of road plus sidewalks, and the width of the kerb, in metres."""
START = -8.0
END = 41.0
SQUARE_HALF = 9.0
"""Start of the houses (in the shortest town), end of the road at the square, and half the square's width."""
CROSSING = 13.0
"""Start of the zebra crossing."""


class FaceTable(NamedTuple):
    """The F faces of a town as arrays; face 0 is the ground."""

    material: NDArray[np.int64]
    style: NDArray[np.int64]
    tint: NDArray[np.int64]
    columns: NDArray[np.int64]
    storeys: NDArray[np.int64]
    door: NDArray[np.int64]
    shutters: NDArray[np.int64]
    origin: NDArray[np.float64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    extent: NDArray[np.float64]
    centre: NDArray[np.float64]
    curve: NDArray[np.float64]


class Town(NamedTuple):
    """Solids, the index of each one's first face, the table of faces, and what lighting needs to know."""

    seed: int
    shapes: tuple[Shape, ...]
    first: tuple[int, ...]
    faces: FaceTable
    footprints: NDArray[np.float64]
    """[K 5] low x, low y, high x, high y, height of what stands on the ground, for ambient occlusion."""
    lamps: NDArray[np.float64]
    """[L 3] positions of the lights."""
    start: float
    """x where the houses begin."""


def _row(side: int, start: float, rng: np.random.Generator) -> list[Shape]:
    """Houses, gardens and driveways of one side of the street."""
    shapes: list[Shape] = []
    styles = rng.permutation(4)
    number = 0
    x = start + float(rng.uniform(-1.0, 1.0))
    while x < END - 7.0:
        width = float(rng.uniform(6.5, 9.5))
        front = WALK_HALF + float(rng.uniform(2.2, 4.0))
        lot = Lot(x, x + width, front, float(rng.uniform(7.0, 9.0)), side)
        shapes += house(lot, int(styles[number % 4]), rng)
        number += 1
        door = x + (width / max(1, round(width / 2.7))) * (max(1, round(width / 2.7)) // 2 + 0.5)
        for _ in range(int(rng.integers(1, 4))):
            at = float(rng.uniform(x + 0.6, x + width - 0.6))
            if abs(at - door) > 1.6:
                shapes += bush(at, side * (front - 0.7), float(rng.uniform(0.45, 0.8)), rng)
        gap = float(rng.uniform(2.0, 4.2))
        shapes += _gap(x + width, gap, front, side, rng)
        x += width + gap
    return shapes


def _gap(x: float, gap: float, front: float, side: int, rng: np.random.Generator) -> list[Shape]:
    """Objects between two houses: a tree behind a hedge, or a car on a driveway before one."""
    middle = x + gap / 2
    parked = gap > 2.6 and rng.random() < 0.6
    at = front + (5.4 if parked else 1.0)
    low, high = sorted((side * at, side * (at + 0.9)))
    shapes: list[Shape] = [hedge((x - 0.1, low), (x + gap + 0.1, high), float(rng.uniform(1.9, 2.5)))]
    shapes += tree(middle, side * (at + 2.6), float(rng.uniform(1.7, 2.3)), rng)
    if parked:
        shapes += car(middle, side * (front + 1.6), 1, rng)
    return shapes


def _avenue(start: float, rng: np.random.Generator) -> tuple[list[Shape], list[tuple[float, float, float]]]:
    """Trees and lamps along both sidewalks, and cars at the far end of the street."""
    shapes: list[Shape] = []
    lights = []
    for side in (-1, 1):
        shift = float(rng.uniform(0.0, 3.0))
        for k in range(6 + math.ceil((START - start) / 8.2)):
            x = start + 3.0 + shift + 8.2 * k
            if x < END and rng.random() < 0.85:
                shapes += tree(x, side * (WALK_HALF + 0.9), float(rng.uniform(1.05, 1.65)), rng)
        for k in range(5 + math.ceil((START - start) / 11.0)):
            x = start + 6.0 + 11.0 * k + (5.5 if side > 0 else 0.0)
            shapes += lamp(x, side * (ROAD_HALF + 0.55))
            lights.append((x, side * (ROAD_HALF + 0.55), LANTERN))
        shapes += car(float(rng.uniform(34.0, 38.0)), side * (ROAD_HALF - 1.05), 0, rng)
    return shapes, lights


def _wood(start: float, rng: np.random.Generator) -> list[Shape]:
    """Overlapping crowns on a rectangle around the town."""
    low = np.array([start - 9.0, -27.0])
    high = np.array([70.0, 27.0])
    shapes: list[Shape] = []
    for x in np.arange(low[0], high[0], 4.0):
        for y in (low[1], high[1]):
            shapes.append(
                forest(float(x), float(y) + float(rng.uniform(-1, 1)), float(rng.uniform(3.4, 4.6)), rng)
            )
    for y in np.arange(low[1], high[1], 4.0):
        for x in (low[0], high[0]):
            shapes.append(
                forest(float(x) + float(rng.uniform(-1, 1)), float(y), float(rng.uniform(3.4, 4.6)), rng)
            )
    return shapes


def build_town(seed: int, extra: float = 0.0) -> Town:
    """The town of a seed, its street longer by `extra` metres: same seed and length, same town."""
    begin = START - extra
    rng = np.random.default_rng([0x70574E, seed])
    shapes = church(END + 7.0, rng)
    avenue, lights = _avenue(begin, rng)
    shapes += _row(-1, begin, rng) + _row(1, begin, rng) + avenue + _wood(begin, rng)
    for side in (-1, 1):
        shapes += tree(END + 4.0, side * 7.2, 2.0, rng) + tree(END + 12.0, side * 10.5, 2.4, rng)
        low, high = sorted((side * 9.4, side * 10.2))
        shapes.append(hedge((END + 0.5, low), (END + 9.0, high), 1.2))
    x, y, z = np.eye(3)
    faces = [Face(Finish(Material.GROUND), 0 * z, x, y, np.zeros(2))]
    first = []
    for shape in shapes:
        first.append(len(faces))
        faces += shape.faces
    solid = [
        s
        for s in shapes
        if s.low[2] < 0.4
        and abs(s.low[1] + s.high[1]) < 40.0
        and s.low[0] > begin - 4.0
        and np.ptp([s.low[0], s.high[0]]) > 0.7
    ]
    prints = np.array([[*s.low[:2], *s.high[:2], s.high[2]] for s in solid])
    numbers = np.array([face.finish for face in faces], dtype=np.int64)
    frames = [np.stack(rows) for rows in zip(*(face[1:] for face in faces), strict=True)]
    table = FaceTable(*numbers.T, *frames)
    return Town(seed, tuple(shapes), tuple(first), table, prints, np.array(lights), begin)
