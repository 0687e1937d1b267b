"""How far cameras are from the truth, after the similarity that brings them closest to it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Miss(NamedTuple):
    position: float
    """Largest distance of a camera from its true place, as a share of the diagonal of the true places' box."""
    rms: float
    """Root mean square of the same."""
    degrees: float
    """Largest angle between a camera's axes and the true ones."""


def align(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Scale s, rotation R and offset t that make s R a + t closest to b [V 3] (Umeyama, 1991)."""
    centre_a, centre_b = a.mean(0), b.mean(0)
    u, d, vt = np.linalg.svd((b - centre_b).T @ (a - centre_a) / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u * sign @ vt
    scale = float((d * sign).sum() / ((a - centre_a) ** 2).sum(1).mean())
    return scale, turn, centre_b - scale * turn @ centre_a


def misses(found: NDArray[np.float64], truth: NDArray[np.float64]) -> Miss:
    """Of poses [V 3 4], camera to world."""
    scale, turn, offset = align(found[:, :, 3], truth[:, :, 3])
    moved = scale * found[:, :, 3] @ turn.T + offset
    extent = float(np.linalg.norm(np.ptp(truth[:, :, 3], axis=0)))
    away = np.linalg.norm(moved - truth[:, :, 3], axis=1) / extent
    between = np.einsum("ij,vjk,vlk->vil", turn, found[:, :, :3], truth[:, :, :3])
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    return Miss(float(away.max()), float(np.sqrt((away**2).mean())), float(np.degrees(np.arccos(cosine.clip(-1, 1))).max()))
