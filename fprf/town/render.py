"""One view of the town: colours, exact depth, labels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .layout import Town
from .light import shade
from .palettes import Palette
from .sky import sky
from .surface import labels
from .trace import View, cast, directions

__all__ = ["Picture", "colours", "geometry", "render"]

_SAMPLES = 2
"""Colour samples per pixel side."""


class Picture(NamedTuple):
    """A view [H W ...]."""

    rgb: NDArray[np.uint8]
    """sRGB, the mean of 2x2 samples per pixel."""
    depth: NDArray[np.float32]
    """Metres along the unit ray through the pixel's centre; inf = sky."""
    labels: NDArray[np.uint8]
    """Class at the pixel's centre, see `fprf.town.classes`."""


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
    ray, face, distance = np.stack(d, -1).reshape(-1, 3), hits.face.ravel(), hits.distance.ravel()
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
