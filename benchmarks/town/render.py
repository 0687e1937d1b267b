"""Views of the town: camera poses, ray tracing, light and sky, and pictures with exact depth and labels.

Rays are traced in float64, vectorised over the pixels that a solid can cover. Every operation is elementwise,
so the depth of a ray does not depend on which other rays are traced beside it. Surfaces are Lambertian: the
radiance of a surface point is a function of the point alone, so all views agree on it. Haze too depends on
the place (how far outside the street it lies), not on the camera.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fprf.io.images import srgb_to_linear

from .layout import END, Town
from .paint import foliage_normals, paint
from .palettes import Palette
from .shapes import Ellipsoid, Material, Polyhedron, Shape
from .surface import fractal2, hashed, labels, noise2, step

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
    """Unit world directions x, y, z, each [samples·H samples·W], through a regular grid of samples per pixel
    side.
    """
    columns = (np.arange(view.width * samples) + 0.5) / samples - view.width / 2
    rows = (np.arange(view.height * samples) + 0.5) / samples - view.height / 2
    a, b = np.meshgrid(columns / view.focal, -rows / view.focal)
    length = np.sqrt(a * a + b * b + 1.0)
    r = view.pose[:, :3]
    x, y, z = ((r[i, 0] * a + r[i, 1] * b - r[i, 2]) / length for i in range(3))
    return x, y, z


def _enter(shape: Shape, o: tuple[Array, ...], d: tuple[Array, ...]) -> tuple[Array, NDArray[np.int32] | int]:
    """Distance at which rays enter a solid from outside (inf = never) and the face, counted within the
    solid.
    """
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
    px = o[0] - shape.centre[0]
    py = o[1] - shape.centre[1]
    t = _root(d[0] * d[0] + d[1] * d[1], px * d[0] + py * d[1], px * px + py * py - shape.radius**2)
    with np.errstate(invalid="ignore"):
        z = o[2] + t * d[2]
        return np.where((t > _NEAR) & (z >= shape.low[2]) & (z <= shape.high[2]), t, np.inf), 0


def _root(a: Array, b: Array, c: Array) -> Array:
    """The smaller root of a t² + 2 b t + c, inf where there is none."""
    square = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(square > 0, (-b - np.sqrt(square)) / a, np.inf)


def _enter_polyhedron(
    shape: Polyhedron, o: tuple[Array, ...], d: tuple[Array, ...]
) -> tuple[Array, NDArray[np.int32]]:
    size = d[0].shape
    enter = np.full(size, -np.inf)
    leave = np.full(size, np.inf)
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
    low = np.stack([s.low for s in town.shapes])
    high = np.stack([s.high for s in town.shapes])
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corners = np.where(bits, high[:, None], low[:, None]) - view.pose[:, 3]
    local = corners @ view.pose[:, :3]
    ends = np.array([(a, a | 1 << k) for a in range(8) for k in range(3) if not a >> k & 1])
    a = local[:, ends[:, 0]]
    b = local[:, ends[:, 1]]
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
        bounds += [
            np.clip(least * samples - 1, 0, size * samples),
            np.clip(most * samples + 2, 0, size * samples),
        ]
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


def _across(sun: Array) -> tuple[Array, Array]:
    """Two unit vectors square to the sun's rays and to each other, the first one level."""
    level = np.cross(sun, [0.0, 0.0, 1.0])
    level /= np.linalg.norm(level)
    return level, np.cross(sun, level)


def shadowed(
    town: Town, points: Array, sun: Array, foliage: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], ...]:
    """Masks: something solid, and foliage, stands between points [N 3] and the sun (a unit vector towards
    it).

    `foliage` says of each solid whether it lets some light through.
    """
    frame = np.stack([*_across(sun), sun])
    place = points @ frame.T
    order = np.argsort(place[:, 0], kind="stable")
    place = place[order]
    points = points[order]
    dark = np.zeros((2, len(points)), dtype=np.bool_)
    for shape, leafy in zip(town.shapes, foliage, strict=True):
        middle = frame @ (shape.low + shape.high) / 2
        half = np.abs(frame) @ (shape.high - shape.low) / 2
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


FIELD_OF_VIEW = 75.0
"""Horizontal, in degrees."""
_YAW = (0.0, 43.0, -22.0, 22.0, -43.0)
"""Degrees to the left of the street's direction, in turn: five of them, so that every 8th view meets all."""
_FROM = -2.0
_TO = 24.0
_EVERY = 8


def is_test(view: int) -> bool:
    """True for held-out views: every 8th, the first one included."""
    return view % _EVERY == 0


def walk(*, seed: int, views: int, width: int, height: int, extra: float = 0.0) -> list[View]:
    """Poses up the street and back down again, always facing its far end; looks to a side come from across
    the road.

    In a street that is `extra` metres longer the walk begins as much further back.

    The walk starts a tenth into its loop: the rearmost views, which see what no other does, are then for
    training.
    """
    rng = np.random.default_rng([0x3A1C, seed])
    focal = width / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
    result = []
    for k in range(views):
        yaw = _YAW[k % len(_YAW)] + float(rng.uniform(-6, 6))
        way = 1.0 - abs(2.0 * (((k + 0.5) / views + 0.1) % 1.0) - 1.0)
        x = _FROM - extra + (_TO - _FROM + extra) * way
        y = -2.6 * math.sin(math.radians(2.0 * yaw)) + 1.4 * math.sin(2.4 * k) + float(rng.uniform(-0.3, 0.3))
        place = np.array([x, float(np.clip(y, -3.2, 3.2)), float(rng.uniform(1.6, 2.4))])
        result.append(View(_pose(place, yaw, float(rng.uniform(4.0, 9.0))), focal, width, height))
    return result


def _pose(place: NDArray[np.float64], yaw: float, pitch: float) -> NDArray[np.float64]:
    """Camera to world [3 4], OpenGL axes, from degrees of yaw (leftward from +x) and pitch (upward)."""
    a = math.radians(yaw)
    b = math.radians(pitch)
    forward = np.array([math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), math.sin(b)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    return np.column_stack([right, np.cross(right, forward), -forward, place])


Colours = NDArray[np.float32]


def sun_direction(look: Palette) -> Array:
    """Unit vector towards the sun."""
    a = math.radians(look.azimuth)
    e = math.radians(look.elevation)
    return np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])


def sky(direction: Array, look: Palette) -> Colours:
    """sRGB colours [N 3] in [0, 1] of the sky in unit directions [N 3]."""
    height = np.clip(direction[:, 2], 0.0, 1.0)
    rise = step(height, -0.05, 0.75)[:, None] ** 0.7
    colour = np.array(look.horizon) * (1 - rise) + np.array(look.zenith) * rise
    # Clouds lie on a plane overhead; flattened towards the horizon, where they would alias.
    plane = direction[:, :2] / (height + 0.28)[:, None] * 2.2
    puff = 0.7 * fractal2(plane[:, 0], plane[:, 1], 131) + 0.3 * fractal2(
        3 * plane[:, 0], 3 * plane[:, 1], 133
    )
    cover = step(puff, 0.78 - 0.45 * look.cloudiness, 1.02 - 0.45 * look.cloudiness)[:, None] * 0.85
    toward = np.clip(direction @ sun_direction(look), 0, 1)[:, None]
    colour = colour + np.array(look.glow) * (toward**6 + 1.5 * toward**60)
    colour = colour * (1 - cover) + (np.array(look.clouds) * (0.86 + 0.2 * toward**4)) * cover
    if look.stars > 0:
        grid = direction[:, :2] / (height + 0.5)[:, None] * 26.0
        whole = np.floor(grid)
        i, j = whole.astype(np.int64).T
        apart = grid - whole - 0.3 - 0.4 * np.stack([hashed(141, i, j), hashed(142, i, j)], 1)
        star = np.exp(-(apart**2).sum(1) / 0.012) * (hashed(143, i, j) > 0.88) * hashed(144, i, j)
        colour = colour + look.stars * (star * (1 - cover[:, 0]))[:, None]
    return np.asarray(np.clip(colour, 0, 1), np.float32)


def _encode(light: NDArray[np.floating]) -> Colours:
    """Linear light to sRGB through a shoulder that keeps highlights from clipping."""
    x = np.maximum(light, 0)
    x = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    x = np.clip(x, 0, 1)
    return np.asarray(np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055), np.float32)


def normals_at(town: Town, face: NDArray[np.integer], points: Array) -> Colours:
    """Normals [N 3] of faces [N], round ones at their points [N 3]."""
    faces = town.faces
    flat = np.cross(faces.u, faces.v)
    round_ = (points - faces.centre[face]) * faces.curve[face]
    length = np.linalg.norm(round_, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0, round_ / np.maximum(length, 1e-12), flat[face]), np.float32)


def _occlusion(town: Town, points: Array, ground: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Share of the ambient light that reaches a point: less on the ground close to walls, hedges and cars."""
    open_ = np.ones(len(points), dtype=np.float32)
    at = np.flatnonzero(ground)
    at = at[np.argsort(points[at, 0], kind="stable")]  # then what one footprint can reach lies together
    x = points[at, 0].astype(np.float32)
    y = points[at, 1].astype(np.float32)
    least = np.ones(len(at), dtype=np.float32)
    for low_x, low_y, high_x, high_y, height in town.footprints.astype(np.float32):
        reach = min(0.5 * float(height), 2.0)
        part = slice(*np.searchsorted(x, [low_x - reach, high_x + reach]))
        dx = np.maximum(np.maximum(low_x - x[part], x[part] - high_x), 0)
        dy = np.maximum(np.maximum(low_y - y[part], y[part] - high_y), 0)
        near = 1 - np.minimum((dx + dy) / reach, 1)
        least[part] *= 1 - np.float32(0.45) * near * near
    open_[at] = least
    return open_


def _lamplight(town: Town, points: Array, normals: Colours, look: Palette) -> Colours:
    total = np.zeros(len(points), dtype=np.float32)
    p = points.astype(np.float32)
    for lamp in town.lamps.astype(np.float32):
        at = np.flatnonzero((np.abs(p[:, 0] - lamp[0]) < 14) & (np.abs(p[:, 1] - lamp[1]) < 14))
        to = lamp - p[at]
        square = (to * to).sum(1)
        facing = np.maximum((normals[at] * to).sum(1) / np.sqrt(square), 0)
        total[at] += facing * (1 - step(square, 60.0, 196.0)) / (square + 1.0)
    return total[:, None] * (np.array(look.light, dtype=np.float32) ** 1.5) * np.float32(look.lamps)


def shade(town: Town, look: Palette, face: NDArray[np.integer], points: Array) -> Colours:
    """sRGB colours [N 3] in [0, 1] of surface points [N 3] on faces [N] (>= 0)."""
    sun = sun_direction(look)
    normals = normals_at(town, face, points)
    kinds = town.faces.material[face]
    leafy = np.flatnonzero(kinds == Material.FOLIAGE)
    distant = town.faces.style[face[leafy]] == 1
    lit = np.maximum(normals @ sun.astype(np.float32), 0)
    normals[leafy] = foliage_normals(points[leafy], normals[leafy], distant)
    bent = np.maximum(normals[leafy] @ sun.astype(np.float32), 0)
    lit[leafy] = np.where(lit[leafy] > 0, bent, 0) * 0.8 + 0.1 * bent
    albedo, glow = paint(town, face, points, normals, look)
    through = np.array([town.faces.material[k] == Material.FOLIAGE for k in town.first])
    facing = np.flatnonzero(lit > 0)
    solid, leaves = shadowed(town, points[facing], sun, through)
    # Light falls through crowns in patches, whose pattern runs along the sun's rays.
    a, b = (points[facing] @ axis for axis in _across(sun))
    dapple = step(noise2(2.2 * a, 2.2 * b, 121), 0.55, 0.8) * 0.7
    lit[facing] *= np.where(solid, 0, np.where(leaves, dapple, 1))
    up = (0.5 + 0.5 * normals[:, 2])[:, None]
    around = np.array(look.ambient) * up + np.array(look.bounce) * (1 - up)
    around = around * _occlusion(town, points, kinds == Material.GROUND)[:, None]
    light = lit[:, None] * np.array(look.sun) + around
    if look.lamps > 0:
        light = light + _lamplight(town, points, normals, look)
    colour = srgb_to_linear(albedo).astype(np.float32) * light * look.exposure + glow * look.exposure
    outside = np.maximum(
        np.abs(points[:, 1]) - 9.0, np.maximum(town.start - points[:, 0], points[:, 0] - END)
    )
    haze = (1 - np.exp(-np.maximum(outside, 0) / 40.0 * 2.0)) * look.haziness
    hazy = np.array(look.haze) * haze[:, None]
    return np.asarray(_encode(colour) * (1 - haze[:, None]) + hazy, np.float32)


_SAMPLES = 2
"""Colour samples per pixel side."""


class Picture(NamedTuple):
    """A view [H W ...]."""

    rgb: NDArray[np.uint8]
    """sRGB, the mean of 2x2 samples per pixel."""
    depth: NDArray[np.float32]
    """Metres along the unit ray through the pixel's centre; inf = sky."""
    labels: NDArray[np.uint8]
    """Class at the pixel's centre, see `benchmarks.town.surface`."""


def geometry(town: Town, view: View) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Depth and labels of a view; no palette takes part."""
    d = directions(view, 1)
    hits = cast(town, view, d, 1)
    seen = np.where(np.isfinite(hits.distance), hits.distance, 0.0)
    points = view.pose[:, 3] + seen[..., None] * np.stack(d, -1)
    kinds = labels(town, hits.face.ravel(), points.reshape(-1, 3))
    return hits.distance.astype(np.float32), kinds.reshape(hits.face.shape)


def colours(town: Town, view: View, look: Palette, samples: int) -> NDArray[np.float32]:
    """sRGB in [0, 1] of samples x samples rays per pixel: [samples·H samples·W 3]."""
    d = directions(view, samples)
    hits = cast(town, view, d, samples)
    ray = np.stack(d, -1).reshape(-1, 3)
    face = hits.face.ravel()
    distance = hits.distance.ravel()
    result = np.empty((len(ray), 3), dtype=np.float32)
    at = np.flatnonzero(face >= 0)
    result[at] = shade(town, look, face[at], view.pose[:, 3] + distance[at, None] * ray[at])
    at = np.flatnonzero(face < 0)
    result[at] = sky(ray[at], look)
    return result.reshape(*hits.face.shape, 3)


def render(town: Town, view: View, look: Palette) -> Picture:
    """A view under a palette."""
    fine = colours(town, view, look, _SAMPLES)
    mean = fine.reshape(view.height, _SAMPLES, view.width, _SAMPLES, 3).mean((1, 3))
    depth, kinds = geometry(town, view)
    return Picture(np.clip(np.rint(mean * 255), 0, 255).astype(np.uint8), depth, kinds)
