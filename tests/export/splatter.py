"""A small renderer of 3D Gaussians as splat viewers draw them, in NumPy: the judge of exported files.

Each Gaussian is projected to the image plane (Zwicker et al. 2001), widened by 0.3 square pixels, and blended front to back.
"""

from typing import NamedTuple

import numpy as np

WIDEN = 0.3


class Gaussians(NamedTuple):
    at: np.ndarray
    deviation: np.ndarray
    turn: np.ndarray
    """Quaternion w x y z."""
    colour: np.ndarray
    opacity: np.ndarray


def table(data: bytes) -> np.ndarray:
    """The vertices of a binary PLY, by nothing but its header."""
    head, _, body = data.partition(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
    rows, count, inside = [], 0, False
    for line in head.decode("ascii").splitlines():
        word = line.split()
        if word[:1] == ["element"]:
            inside = word[1] == "vertex"
            count = int(word[2]) if inside else count
        elif word[:1] == ["property"] and inside:
            rows.append((word[2], kinds[word[1]]))
    return np.frombuffer(body, dtype=rows, count=count)


def read_gaussians(data: bytes) -> Gaussians:
    v = table(data)

    def columns(*names: str) -> np.ndarray:
        return np.stack([v[name] for name in names], 1).astype(float)

    return Gaussians(
        columns("x", "y", "z"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        0.5 + 0.5 / np.sqrt(np.pi) * columns("f_dc_0", "f_dc_1", "f_dc_2"),
        1 / (1 + np.exp(-v["opacity"].astype(float))),
    )


def read_splat(data: bytes) -> Gaussians:
    raw = np.frombuffer(data, dtype=np.uint8).reshape(-1, 32)
    real = np.ascontiguousarray(raw[:, :24]).view("<f4").astype(float)
    turn = (raw[:, 28:].astype(float) - 128) / 128
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return Gaussians(real[:, :3], real[:, 3:], turn, raw[:, 24:27] / 255.0, raw[:, 27] / 255.0)


def matrices(turn: np.ndarray) -> np.ndarray:
    w, x, y, z = turn.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        1,
    )


def draw(
    g: Gaussians, pose: np.ndarray, focal: float, size: tuple[int, int], behind: tuple[float, float, float] = (0, 0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Image [H W 3] and opacity [H W] of a pinhole view with OpenGL axes and its centre in the middle."""
    width, height = size
    axes = pose[:, :3] * [1, -1, -1]
    local = (g.at - pose[:, 3]) @ axes
    x, y, z = local.T
    ahead = z > 0.05
    z = np.where(ahead, z, 1.0)
    # Viewers bound the slope, so that what lies far beside the picture is not smeared over it.
    sx = np.clip(x / z, -0.65 * width / focal, 0.65 * width / focal)
    sy = np.clip(y / z, -0.65 * height / focal, 0.65 * height / focal)
    zero = np.zeros_like(z)
    jacobian = (
        focal / z[:, None, None] * np.stack([np.stack([zero + 1, zero, -sx], -1), np.stack([zero, zero + 1, -sy], -1)], 1)
    )
    root = jacobian @ axes.T @ (matrices(g.turn) * g.deviation[:, None, :])
    cov = root @ root.transpose(0, 2, 1)
    a, b, c = cov[:, 0, 0] + WIDEN, cov[:, 0, 1], cov[:, 1, 1] + WIDEN
    px, py = focal * x / z + width / 2, focal * y / z + height / 2
    reach = np.ceil(3 * np.sqrt(np.maximum(a, c)))
    ahead &= (px > -reach) & (px < width + reach) & (py > -reach) & (py < height + reach)
    which, where, strength = [], [], []
    for radius in (2**k for k in range(9)):
        some = np.flatnonzero(ahead & (reach <= radius) & (reach > radius / 2 if radius > 1 else True))
        for chunk in np.array_split(some, 1 + len(some) * (2 * radius + 1) ** 2 // 4_000_000):
            grid = np.arange(-radius, radius + 1)
            cx = np.floor(px[chunk]).astype(int)[:, None, None] + grid
            cy = np.floor(py[chunk]).astype(int)[:, None, None] + grid[:, None]
            dx, dy = cx + 0.5 - px[chunk, None, None], cy + 0.5 - py[chunk, None, None]
            det = (a * c - b * b)[chunk, None, None]
            power = (c[chunk, None, None] * dx * dx - 2 * b[chunk, None, None] * dx * dy + a[chunk, None, None] * dy * dy) / det
            alpha = np.minimum(0.99, g.opacity[chunk, None, None] * np.exp(-0.5 * power))
            use = (alpha > 1 / 255) & (cx >= 0) & (cx < width) & (cy >= 0) & (cy < height)
            row, _, _ = np.nonzero(use)
            which.append(chunk[row])
            where.append((cy * width + cx)[use])
            strength.append(alpha[use])
    splat, pixel, alpha = (np.concatenate(part) for part in (which, where, strength))
    order = np.lexsort((z[splat], pixel))
    splat, pixel, alpha = splat[order], pixel[order], alpha[order]
    clear = np.concatenate([[0.0], np.cumsum(np.log1p(-alpha))])
    first = np.searchsorted(pixel, pixel)
    weight = alpha * np.exp(clear[:-1] - clear[first])
    image = np.stack([np.bincount(pixel, weight * g.colour[splat, k], width * height) for k in range(3)], 1)
    covered = np.bincount(pixel, weight, width * height)
    image = image + (1 - covered[:, None]) * np.asarray(behind)
    return image.reshape(height, width, 3), covered.reshape(height, width)
