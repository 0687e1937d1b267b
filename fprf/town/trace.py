"""Nearest hits and shadows: exact, in float64, vectorised over the pixels that a solid can cover.

Every operation is elementwise, so the depth of a ray doesn't depend on which other rays are traced beside it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .layout import Town
from .shapes import Ellipsoid, Polyhedron, Shape

__all__ = ["Hits", "View", "cast", "directions", "shadowed"]

Array = NDArray[np.float64]
_NEAR = 1e-4
"""Metres before which nothing is hit: keeps a surface from shadowing itself."""


class View(NamedTuple):
    """A pinhole camera: pose [3 4] camera to world with OpenGL's axes, focal length and size in pixels."""

    pose: Array
    focal: float
    width: int
    height: int


class Hits(NamedTuple):
    """Distance along the unit ray (inf = sky) and face of the nearest hit (-1 = sky)."""

    distance: Array
    face: NDArray[np.int32]


def directions(view: View, samples: int) -> tuple[Array, Array, Array]:
    """Unit world directions x, y, z, each [samples·H samples·W], through a regular grid of samples per pixel side."""
    columns = (np.arange(view.width * samples) + 0.5) / samples - view.width / 2
    rows = (np.arange(view.height * samples) + 0.5) / samples - view.height / 2
    a, b = np.meshgrid(columns / view.focal, -rows / view.focal)
    length = np.sqrt(a * a + b * b + 1.0)
    r = view.pose[:, :3]
    x, y, z = ((r[i, 0] * a + r[i, 1] * b - r[i, 2]) / length for i in range(3))
    return x, y, z


def _enter(shape: Shape, o: tuple[Array, ...], d: tuple[Array, ...]) -> tuple[Array, NDArray[np.int32] | int]:
    """Distance at which rays enter a solid from outside (inf = never) and the face, counted within the solid."""
    if isinstance(shape, Polyhedron):
        return _enter_polyhedron(shape, o, d)
    if isinstance(shape, Ellipsoid):
        p = [(o[i] - shape.centre[i]) / shape.radii[i] for i in range(3)]
        q = [d[i] / shape.radii[i] for i in range(3)]
        t = _root(
            q[0] * q[0] + q[1] * q[1] + q[2] * q[2],
            p[0] * q[0] + p[1] * q[1] + p[2] * q[2],
            p[0] * p[0] + p[1] * p[1] + p[2] * p[2] - 1.0,
        )
        return np.where(t > _NEAR, t, np.inf), 0
    px, py = o[0] - shape.centre[0], o[1] - shape.centre[1]
    t = _root(d[0] * d[0] + d[1] * d[1], px * d[0] + py * d[1], px * px + py * py - shape.radius**2)
    with np.errstate(invalid="ignore"):
        z = o[2] + t * d[2]
        return np.where((t > _NEAR) & (z >= shape.low[2]) & (z <= shape.high[2]), t, np.inf), 0


def _root(a: Array, b: Array, c: Array) -> Array:
    """The smaller root of a t² + 2 b t + c, inf where there is none."""
    square = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(square > 0, (-b - np.sqrt(square)) / a, np.inf)


def _enter_polyhedron(shape: Polyhedron, o: tuple[Array, ...], d: tuple[Array, ...]) -> tuple[Array, NDArray[np.int32]]:
    size = d[0].shape
    enter, leave = np.full(size, -np.inf), np.full(size, np.inf)
    face = np.zeros(size, dtype=np.int32)
    for k, (n, offset) in enumerate(zip(shape.normals, shape.offsets, strict=True)):
        slope = sum(n[i] * d[i] for i in range(3) if n[i] != 0.0)
        room = offset - sum(n[i] * o[i] for i in range(3) if n[i] != 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = room / slope
        inward = slope < 0
        later = inward & (t > enter)
        enter = np.where(later, t, enter)
        face = np.where(later, np.int32(k), face)
        leave = np.where((slope > 0) & (t < leave), t, leave)
        leave = np.where((slope == 0) & (room < 0), -np.inf, leave)
    return np.where((enter > _NEAR) & (enter <= leave), enter, np.inf), face


def _windows(town: Town, view: View, samples: int) -> NDArray[np.int64]:
    """Per solid the pixel rectangle [row, row end, column, column end] outside which no ray can meet it."""
    low, high = np.stack([s.low for s in town.shapes]), np.stack([s.high for s in town.shapes])
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corners = np.where(bits, high[:, None], low[:, None]) - view.pose[:, 3]
    local = corners @ view.pose[:, :3]
    ends = np.array([(a, a | 1 << k) for a in range(8) for k in range(3) if not a >> k & 1])
    a, b = local[:, ends[:, 0]], local[:, ends[:, 1]]
    near = -0.01
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (near - a[..., 2:]) / (b[..., 2:] - a[..., 2:])
        cut = np.where((a[..., 2:] > near) != (b[..., 2:] > near), a + s * (b - a), np.nan)
        points = np.concatenate([np.where(local[..., 2:] <= near, local, np.nan), cut], 1)
        x = view.focal * points[..., 0] / -points[..., 2] + view.width / 2
        y = -view.focal * points[..., 1] / -points[..., 2] + view.height / 2
    seen = np.isfinite(x).any(1)
    bounds = []
    for value, size in ((y, view.height), (x, view.width)):
        least = np.where(np.isfinite(value), value, np.inf).min(1)
        most = np.where(np.isfinite(value), value, -np.inf).max(1)
        bounds += [np.clip(least * samples - 1, 0, size * samples), np.clip(most * samples + 2, 0, size * samples)]
    rectangle = np.where(seen[:, None], np.stack(bounds, 1), 0.0)
    return np.floor(rectangle).astype(np.int64)


def cast(town: Town, view: View, d: tuple[Array, Array, Array], samples: int) -> Hits:
    """Nearest hits of the rays of `directions(view, samples)`."""
    o = tuple(view.pose[:, 3])
    with np.errstate(divide="ignore"):
        distance = np.where(d[2] < 0, -o[2] / d[2], np.inf)
    face = np.where(d[2] < 0, np.int32(0), np.int32(-1))
    for shape, first, window in zip(town.shapes, town.first, _windows(town, view, samples), strict=True):
        if window[0] >= window[1] or window[2] >= window[3]:
            continue
        part = np.s_[window[0] : window[1], window[2] : window[3]]
        t, k = _enter(shape, o, tuple(c[part] for c in d))
        nearer = t < distance[part]
        distance[part] = np.where(nearer, t, distance[part])
        face[part] = np.where(nearer, np.int32(first) + k, face[part])
    return Hits(distance, face)


def shadowed(town: Town, points: Array, sun: Array, foliage: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], ...]:
    """Whether something solid, and whether foliage, stands between points [N 3] and the sun (a unit vector towards it).

    `foliage` says of each solid whether it lets some light through.
    """
    across = np.cross(sun, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(sun, across), sun])
    place = points @ frame.T
    order = np.argsort(place[:, 0], kind="stable")
    place, points = place[order], points[order]
    dark = np.zeros((2, len(points)), dtype=np.bool_)
    for shape, leafy in zip(town.shapes, foliage, strict=True):
        middle, half = frame @ (shape.low + shape.high) / 2, np.abs(frame) @ (shape.high - shape.low) / 2
        start, stop = np.searchsorted(place[:, 0], [middle[0] - half[0], middle[0] + half[0]])
        near = np.abs(place[start:stop, 1] - middle[1]) <= half[1]
        near &= (place[start:stop, 2] < middle[2] + half[2]) & ~dark[int(leafy), start:stop]
        at = start + np.flatnonzero(near)
        if len(at) == 0:
            continue
        o = tuple(points[at].T)
        t, _ = _enter(shape, o, tuple(np.broadcast_to(c, len(at)) for c in sun))
        dark[int(leafy), at] = t < np.inf
    result = np.empty_like(dark)
    result[:, order] = dark
    return result[0], result[1]
