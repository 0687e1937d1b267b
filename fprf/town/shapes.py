"""Convex solids whose faces carry a finish: what the town is built of.

A face has a frame: an origin (its lowest, leftmost corner as seen from outside), u to the right, v up the face, and its
extent in metres along both. Textures, windows and doors are laid out in these coordinates.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Cylinder",
    "Ellipsoid",
    "Face",
    "Finish",
    "Material",
    "Polyhedron",
    "Shape",
    "box",
    "cylinder",
    "ellipsoid",
    "extrude",
    "pyramid",
]

Array = NDArray[np.float64]
_FLAT: Array = np.zeros(3)


class Material(IntEnum):
    """How a face is painted (finer than its class)."""

    GROUND, FACADE, ROOF, TRIM, FOLIAGE, TRUNK, POST, LANTERN, PAINT, GLASS, TYRE = range(11)


class Finish(NamedTuple):
    """What a face is made of. Whole numbers that painters read; their meaning depends on the material."""

    material: Material
    style: int = 0
    """Facade: 0 brick, 1 plaster, 2 clapboard, 3 timber, 4 stone. Roof: 0 tiles, 1 flat."""
    tint: int = 0
    """Which of the palette's colours for this material."""
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
    """Vertical cylinder between low and high; open at both ends, which are hidden in the ground and in other solids."""

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
    a, b, c = corners @ u, corners @ v, float(corners[0] @ normal)
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
        finishes: K + 2: one per side (from corner k to k + 1), then the cap at `start`, then the one at `stop`.
    """
    across = [i for i in range(3) if i != axis]
    corner = np.asarray(profile, dtype=np.float64)
    rings = np.empty((2, len(corner), 3))
    rings[:, :, across] = corner
    rings[0, :, axis], rings[1, :, axis] = start, stop
    normals, faces = [], []
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
    offsets = np.array([face.origin @ normal for face, normal in zip(faces, normals, strict=True)])
    every = rings.reshape(-1, 3)
    return Polyhedron(np.stack(normals), offsets, tuple(faces), every.min(0), every.max(0))


def box(low: Sequence[float], high: Sequence[float], finishes: Sequence[Finish]) -> Polyhedron:
    """An axis-aligned box; finishes of the sides facing -y, +x, +y, -x, then bottom and top."""
    profile = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    return extrude(profile, 2, low[2], high[2], finishes)


def pyramid(low: Sequence[float], high: Sequence[float], finish: Finish) -> Polyhedron:
    """Four slopes over the base of the box low, high, meeting above its middle at the box's height."""
    base = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    ring = np.column_stack([base, np.full(4, low[2])])
    apex = np.array([*base.mean(0), high[2]])
    normals, faces = [], []
    for k in range(4):
        corners = np.stack([ring[k], ring[(k + 1) % 4], apex])
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        normals.append(normal)
        faces.append(_face(finish, normal, corners))
    normals.append(np.array([0.0, 0.0, -1.0]))
    faces.append(_face(finish, normals[-1], ring))
    offsets = np.array([face.origin @ normal for face, normal in zip(faces, normals, strict=True)])
    return Polyhedron(np.stack(normals), offsets, tuple(faces), np.asarray(low, float), np.asarray(high, float))


def _round(finish: Finish, low: Array, high: Array, curve: Array) -> tuple[Face, ...]:
    x, _, z = np.eye(3)
    return (Face(finish, low, x, z, (high - low)[[0, 2]], (low + high) / 2, curve),)


def ellipsoid(centre: Sequence[float], radii: Sequence[float], finish: Finish) -> Ellipsoid:
    """An ellipsoid of one finish."""
    middle, radius = np.asarray(centre, float), np.asarray(radii, float)
    low, high = middle - radius, middle + radius
    return Ellipsoid(middle, radius, _round(finish, low, high, radius**-2), low, high)


def cylinder(x: float, y: float, low: float, high: float, radius: float, finish: Finish) -> Cylinder:
    """A post of one finish at (x, y) from height low to high."""
    bottom, top = np.array([x - radius, y - radius, low]), np.array([x + radius, y + radius, high])
    return Cylinder(np.array([x, y]), radius, _round(finish, bottom, top, np.array([1.0, 1.0, 0.0])), bottom, top)
