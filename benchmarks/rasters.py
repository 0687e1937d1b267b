"""Small renderers of points and of triangles in NumPy, as viewers draw them: judges of exported files.

Views are pinholes with OpenGL axes and their centre in the middle, as in tests/export/splatter.py. What is behind is black.
"""

import numpy as np

_NEAR = 0.02


def psnr(image: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float:
    """Of pictures in [0, 1], over some pixels or all; at most 99 dB."""
    squares = np.square(image - truth)
    return float(-10 * np.log10(max(float((squares if where is None else squares[where]).mean()), 10**-9.9)))


def to_view(point: np.ndarray, pose: np.ndarray, focal: float, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels [N 2] and depths along the axis [N]; depths up to 0 are behind the camera."""
    local = (point - pose[:, 3]) @ (pose[:, :3] * [1, -1, -1])
    depth = local[:, 2]
    plane = local[:, :2] / np.where(depth > 0, depth, 1)[:, None]
    return focal * plane + np.asarray(size) / 2, depth


def draw_points(
    point: np.ndarray, colour: np.ndarray, pose: np.ndarray, focal: float, size: tuple[int, int], wide: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Image [H W 3] and where it is covered [H W]: each point a square of `wide` pixels, the nearest in front."""
    width, height = size
    pixel, depth = to_view(point, pose, focal, size)
    steps = np.stack(np.meshgrid(*(np.arange(wide) - wide // 2,) * 2), -1).reshape(-1, 2)
    at = (np.floor(pixel)[:, None] + steps).reshape(-1, 2)
    which = np.repeat(np.arange(len(point)), len(steps))
    use = (depth[which] > _NEAR) & ((at >= 0) & (at < [width, height])).all(1)
    at, which = at[use].astype(int), which[use]
    nearest, picked = _nearest(at[:, 1] * width + at[:, 0], depth[which], width * height)
    image = np.zeros((width * height, 3))
    image[picked] = colour[which[nearest]]
    covered = np.zeros(width * height, dtype=bool)
    covered[picked] = True
    return image.reshape(height, width, 3), covered.reshape(height, width)


def draw_triangles(
    point: np.ndarray, face: np.ndarray, colour: np.ndarray, pose: np.ndarray, focal: float, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Image [H W 3] and where it is covered [H W]: colours of vertices, interpolated in the world, seen from both sides."""
    width, height = size
    pixel, depth = to_view(point, pose, focal, size)
    face = face[(depth[face] > _NEAR).all(1)]
    low = np.ceil(pixel[face].min(1) - 0.5).clip(0, size).astype(int)
    high = np.floor(pixel[face].max(1) - 0.5).clip(-1, np.asarray(size) - 1).astype(int)
    reach = (high - low + 1).max(1)
    some = ((high - low) >= 0).all(1)
    where, far, shade = [], [], []
    for side in (2**k for k in range(12)):
        group = np.flatnonzero(some & (reach <= side) & (reach > side // 2))
        for chunk in np.array_split(group, 1 + len(group) * side**2 // 2_000_000):
            steps = np.stack(np.meshgrid(*(np.arange(side),) * 2), -1).reshape(-1, 2)
            at = low[chunk][:, None] + steps
            corner = pixel[face[chunk]]
            share = _barycentric(at + 0.5, corner)
            inside = (share >= 0).all(-1) & (at <= high[chunk][:, None]).all(-1)
            row, cell = np.nonzero(inside)
            # Straight in 1 / depth and colour / depth, as perspective is.
            part = share[row, cell] / depth[face[chunk]][row]
            inverse = part.sum(1)
            where.append(at[row, cell, 1] * width + at[row, cell, 0])
            far.append(1 / inverse)
            shade.append((part[:, :, None] * colour[face[chunk]][row]).sum(1) / inverse[:, None])
    every, z, tint = np.concatenate(where), np.concatenate(far), np.concatenate(shade)
    nearest, picked = _nearest(every, z, width * height)
    image, covered = np.zeros((width * height, 3)), np.zeros(width * height, dtype=bool)
    image[picked], covered[picked] = tint[nearest], True
    return image.reshape(height, width, 3), covered.reshape(height, width)


def _nearest(pixel: np.ndarray, depth: np.ndarray, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Index of the nearest candidate of each pixel that has one, and those pixels."""
    order = np.lexsort((depth, pixel))
    first = np.ones(len(order), dtype=bool)
    first[1:] = pixel[order][1:] != pixel[order][:-1]
    assert len(pixel) == 0 or int(pixel.max()) < pixels
    return order[first], pixel[order][first]


def _barycentric(at: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Shares [F P 3] of the corners [F 3 2] at places [F P 2]; negative outside, also for triangles without area."""
    a, b, c = (corner[:, None, k] for k in range(3))

    def area(u: np.ndarray, v: np.ndarray, w: np.ndarray) -> np.ndarray:
        twice: np.ndarray = (v[..., 0] - u[..., 0]) * (w[..., 1] - u[..., 1]) - (v[..., 1] - u[..., 1]) * (
            w[..., 0] - u[..., 0]
        )
        return twice

    whole = area(a, b, c)
    parts = np.stack([area(b, c, at), area(c, a, at), area(a, b, at)], -1)
    flat = np.abs(whole) < 1e-12
    return np.where(flat[..., None], -1.0, parts / np.where(flat, 1.0, whole)[..., None])
