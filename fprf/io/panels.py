"""Several pictures of one view as one: beside each other, or in strips under a seam that moves."""

import math
from collections.abc import Sequence

import numpy as np

from ..errors import DataError
from .images import Picture, checked

__all__ = ["beside", "seams", "wiped"]

_SEAM = 2
"""Pixels of the line between strips."""


def beside(pictures: Sequence[Picture]) -> Picture:
    """The pictures from left to right, with a thin line between them. Raises DataError where their heights differ."""
    if len({checked(picture).shape[0] for picture in pictures}) != 1:
        raise DataError(f"pictures of heights {[picture.shape[0] for picture in pictures]} cannot lie beside each other")
    line = np.full((pictures[0].shape[0], _SEAM, 3), 255, np.uint8)
    parts = [part for picture in pictures for part in (line, picture)][1:]
    return np.concatenate(parts, axis=1)


def seams(count: int, at: float) -> list[float]:
    """Where `count` strips meet, as shares of the width; over `at` in [0, 1] each seam swings by half a strip and back."""
    swing = math.sin(2 * math.pi * at) / (2 * count)
    return [k / count + swing for k in range(1, count)]


def wiped(pictures: Sequence[Picture], at: float) -> Picture:
    """A strip of each picture in turn, in one picture. Raises DataError where sizes differ."""
    if len({checked(picture).shape for picture in pictures}) != 1:
        raise DataError(f"pictures of shapes {[picture.shape for picture in pictures]} cannot share one picture")
    width = pictures[0].shape[1]
    edges = [0, *(round(seam * width) for seam in seams(len(pictures), at)), width]
    whole = np.concatenate([p[:, a:b] for p, a, b in zip(pictures, edges[:-1], edges[1:], strict=True)], axis=1)
    for edge in edges[1:-1]:
        whole[:, max(0, edge - _SEAM // 2) : edge + _SEAM - _SEAM // 2] = 255
    return whole
