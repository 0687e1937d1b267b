"""A walk along the street: camera poses with enough overlap and baseline to reconstruct it."""

import math

import numpy as np
from numpy.typing import NDArray

from .trace import View

__all__ = ["FIELD_OF_VIEW", "is_test", "walk"]

FIELD_OF_VIEW = 75.0
"""Horizontal, in degrees."""
_YAW = (0.0, 43.0, -22.0, 22.0, -43.0)
"""Degrees to the left of the street's direction, in turn: five of them, so that every 8th view meets all."""
_FROM, _TO = -2.0, 24.0
_EVERY = 8


def is_test(view: int) -> bool:
    """Whether a view is held out: every 8th, the first one included."""
    return view % _EVERY == 0


def walk(*, seed: int, views: int, width: int, height: int, extra: float = 0.0) -> list[View]:
    """Poses up the street and back down again, always facing its far end; looks to a side come from across the road.

    In a street that is `extra` metres longer the walk begins as much further back.

    The walk starts a tenth into its loop: the rearmost views, which see what no other does, are then for training.
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
    a, b = math.radians(yaw), math.radians(pitch)
    forward = np.array([math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), math.sin(b)])
    right = np.array([math.sin(a), -math.cos(a), 0.0])
    return np.column_stack([right, np.cross(right, forward), -forward, place])
