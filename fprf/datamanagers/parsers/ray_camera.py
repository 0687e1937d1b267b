"""The camera behind given rays: some captures store an origin and a direction for each pixel instead of a calibration.

A pose, focal lengths, a principal point and OpenCV's k1 k2 p1 p2 are fitted to a lattice of the rays by damped least squares on
pixels. What is left is told: a rolling shutter's rays come from many places, and one pose is only their mean.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["RayCamera", "fit_camera"]

Array = NDArray[np.float64]
_LATTICE = 24
"""Rays along each side that are looked at."""
_ROUNDS = 30


class RayCamera(NamedTuple):
    """A fitted camera; axes are OpenGL's."""

    pose: Array
    """Camera to world [3 4]."""
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float, float]
    """k1 k2 0 0 p1 p2."""
    error: float
    """Root mean square distance of the fitted pixels from the true ones."""
    drift: float
    """Largest distance of a ray's origin from the pose's."""


def fit_camera(origin: NDArray[np.float32], direction: NDArray[np.float32]) -> RayCamera:
    """The camera of rays [H W 3] through pixel centres. Raises ValueError where they are not those of any lens."""
    height, width = origin.shape[:2]
    rows = np.unique(np.linspace(0, height - 1, min(_LATTICE, height)).round().astype(np.int64))
    columns = np.unique(np.linspace(0, width - 1, min(_LATTICE, width)).round().astype(np.int64))
    grid = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    ray = direction[grid[:, 1], grid[:, 0]].astype(np.float64)
    long = np.linalg.norm(ray, axis=1, keepdims=True)
    if not (long > 1e-9).all() or len(grid) < 16:
        raise ValueError("rays without a direction, or too few of them")
    ray /= long
    pixel = grid.astype(np.float64) + 0.5
    turn = _axes(ray, grid)
    local = ray @ turn.T
    if not (local[:, 2] > 0.02).all():
        raise ValueError("rays that look backwards: more than a half space in one image")
    plane = local[:, :2] / local[:, 2:]
    # Straight lines first: focal lengths and centre of a pinhole.
    (fx, cx), (fy, cy) = (np.polyfit(plane[:, a], pixel[:, a], 1) for a in range(2))
    if not (fx > 0 and fy > 0):
        raise ValueError("rays of a mirrored image")
    best = _refine(ray, pixel, turn, np.array([0.0, 0.0, 0.0, fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0]))
    turned = _rotation(best[:3]) @ turn
    residual = _project(ray @ turned.T, best) - pixel
    place = origin.reshape(-1, 3).astype(np.float64)
    middle = place.mean(0)
    axes = np.stack([turned[0], -turned[1], -turned[2]], 1)
    return RayCamera(
        np.concatenate([axes, middle[:, None]], 1),
        (float(best[3]), float(best[4])),
        (float(best[5]), float(best[6])),
        (float(best[7]), float(best[8]), 0.0, 0.0, float(best[9]), float(best[10])),
        float(np.sqrt((residual**2).sum(1).mean())),
        float(np.linalg.norm(place - middle, axis=1).max()),
    )


def _axes(ray: Array, grid: NDArray[np.int64]) -> Array:
    """Rows: right, down and forward, as the corners of the lattice say."""
    x, y = grid[:, 0], grid[:, 1]
    left, right = ray[x == x.min()].mean(0), ray[x == x.max()].mean(0)
    above, below = ray[y == y.min()].mean(0), ray[y == y.max()].mean(0)
    ahead = np.cross(right - left, below - above)
    if np.linalg.norm(ahead) < 1e-9:
        raise ValueError("rays that span no image")
    ahead /= np.linalg.norm(ahead)
    if ahead @ ray.mean(0) < 0:
        raise ValueError("rays of a mirrored image")
    across = (right - left) - ((right - left) @ ahead) * ahead
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(ahead, across), ahead])


def _refine(ray: Array, pixel: Array, turn: Array, start: Array) -> Array:
    """Levenberg and Marquardt's steps with differences for slopes: eleven numbers, a few hundred rays."""

    def miss(value: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            out = (_project(ray @ (_rotation(value[:3]) @ turn).T, value) - pixel).reshape(-1)
        return np.nan_to_num(out, nan=1e6, posinf=1e6, neginf=-1e6)

    value, damping = start, 1e-3
    error = miss(value)
    scale = np.array([1e-6] * 3 + [1e-3 * start[3] / 1e3] * 4 + [1e-6] * 4)
    for _ in range(_ROUNDS):
        slope = np.stack([(miss(value + np.eye(11)[k] * scale[k]) - error) / scale[k] for k in range(11)], 1)
        normal = slope.T @ slope
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(11), -slope.T @ error)
        tried = miss(value + step)
        if (tried**2).sum() < (error**2).sum():
            gained = 1 - (tried**2).sum() / max((error**2).sum(), 1e-300)
            value, error, damping = value + step, tried, damping / 10
            if gained < 1e-9:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return value


def _project(local: Array, value: Array) -> Array:
    """Pixels of rays in OpenCV's camera axes, by fx fy cx cy k1 k2 p1 p2 from the fourth number on."""
    fx, fy, cx, cy, k1, k2, p1, p2 = value[3:]
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], 1)


def _rotation(vector: Array) -> Array:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-12:
        return np.asarray(np.eye(3) + cross)
    s, c = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
    return np.asarray(np.eye(3) + s * cross + c * (cross @ cross))
