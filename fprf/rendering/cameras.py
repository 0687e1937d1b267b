"""Calibrated views and the rays through their pixels.

World metres (or whatever unit the capture has), float64 throughout: the space that fields live in is recentred from it.
Axes are OpenGL's: x right, y up, the camera looks along -z. Pixel centres lie at +0.5.
"""

from dataclasses import dataclass
from typing import Annotated

from torch import Tensor

__all__ = ["Cameras"]


@dataclass(frozen=True)
class Cameras:
    """V views. `lens` is 0 pinhole, 1 OpenCV (k1 k2 k3 k4 radial, p1 p2 tangential), 2 fisheye (equidistant, k1..k4)."""

    pose: Annotated[Tensor, "V 3 4"]
    """Camera to world, float64."""
    focal: Annotated[Tensor, "V 2"]
    """fx, fy in pixels, float64."""
    centre: Annotated[Tensor, "V 2"]
    """Principal point in pixels, float64."""
    size: Annotated[Tensor, "V 2"]
    """Width, height, int64."""
    distortion: Annotated[Tensor, "V 6"]
    """k1 k2 k3 k4 p1 p2, float64; zeros for a pinhole."""
    lens: Annotated[Tensor, "V"]
    """int64, see above."""

    def __len__(self) -> int:
        return len(self.pose)
