"""Which frames of a video are sharp.

The sharpness of an image is the variance of its Laplacian on grey levels in [0, 255]: blur takes the fine edges first. It
depends on what is shown, so frames are compared with their neighbours only.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from ..datamanagers.images import Image

__all__ = ["Choice", "choose", "sharpness"]

_SIDE = 960
"""Longest side at which sharpness is measured: finer detail is mostly noise, and larger images take long."""
_NEIGHBOURS = 2
"""Windows on each side that a window's best frame is compared with."""


class Choice(NamedTuple):
    """One frame of each window, and what became of the others."""

    chosen: list[int]
    """Frames, in their order."""
    dropped: dict[int, str]
    """The other frames with the reason."""


def sharpness(image: Image) -> float:
    """Variance of the Laplacian of an RGB image [H W 3]; 0 for an even one."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = _SIDE / max(grey.shape)
    if scale < 1:
        grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def choose(scores: Sequence[float], count: int, least: float) -> Choice:
    """The sharpest frame of each of `count` windows of equal length; the first of equally sharp ones.

    A window whose best frame has less than `least` times the median sharpness of the windows around it gives none: all of
    it is blurred, as in a quick turn. `least` lies in [0, 1). With `count` frames or fewer every frame is a window.
    """
    windows = min(count, len(scores))
    edges = [round(k * len(scores) / windows) for k in range(windows + 1)] if windows else [0]
    best = [max(range(low, high), key=lambda i: (scores[i], -i)) for low, high in pairwise(edges)]
    dropped = {}
    for (low, high), top in zip(pairwise(edges), best, strict=True):
        for frame in range(low, high):
            if frame != top:
                dropped[frame] = f"less sharp than frame {top} ({scores[frame]:.0f} < {scores[top]:.0f})"
    chosen = []
    for k, top in enumerate(best):
        around = [scores[best[j]] for j in range(max(0, k - _NEIGHBOURS), min(windows, k + _NEIGHBOURS + 1)) if j != k]
        usual = float(np.median(around)) if around else 0.0
        if scores[top] < least * usual:
            dropped[top] = f"blurred, like all frames around it (sharpness {scores[top]:.0f}, usual there is {usual:.0f})"
        else:
            chosen.append(top)
    return Choice(chosen, dict(sorted(dropped.items())))
