"""Calibrated views and the rays through their pixels.

World metres (or whatever unit the capture has), float64 throughout: the space that fields live in is recentred from it.
Axes are OpenGL's: x right, y up, the camera looks along -z. Pixel centres lie at +0.5.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Annotated

import torch
from torch import Tensor

from .lens import bend, lens_reach, unbend

__all__ = ["Cameras", "pixel_grid", "project", "rays_through", "sees"]


@dataclass(frozen=True)
class Cameras:
    """V views. `lens` is 0 pinhole, 1 OpenCV (k1..k4 radial, p1 p2 tangential), 2 fisheye (equidistant, k1..k4),
    3 panorama (equirectangular: pixels are angles)."""

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

    @cached_property
    def reach(self) -> Annotated[Tensor, "V"]:
        """How far out each lens maps one to one: radius at depth 1, or a fisheye's angle; infinite for a pinhole."""
        return lens_reach(self.distortion, self.lens)

    def select(self, index: Annotated[Tensor, "M"]) -> "Cameras":
        """Some of the views, in the order of `index` (int64, or a mask of all)."""
        return Cameras(
            pose=self.pose[index],
            focal=self.focal[index],
            centre=self.centre[index],
            size=self.size[index],
            distortion=self.distortion[index],
            lens=self.lens[index],
        )

    def to(self, device: torch.device) -> "Cameras":
        """The same views, their numbers on a device."""
        return Cameras(*(getattr(self, field.name).to(device) for field in fields(self)))

    def resized(self, size: Annotated[Tensor, "V 2"]) -> "Cameras":
        """The same views on another pixel grid: intrinsics move by the exact ratio of each axis."""
        ratio = size.to(self.focal) / self.size.to(self.focal)
        return replace(self, focal=self.focal * ratio, centre=self.centre * ratio, size=size.to(self.size))

    def scaled(self, downscale: float) -> "Cameras":
        """The same views at 1/downscale of their size, rounded to whole pixels and at least one."""
        return self.resized((self.size.double() / downscale).round().clamp_min(1))


def pixel_grid(cameras: Cameras, view: int) -> Annotated[Tensor, "N 2"]:
    """All N = H * W pixel centres of a view, row by row, float64: x in [0.5, W - 0.5], y in [0.5, H - 0.5]."""
    width, height = cameras.size[view].tolist()
    device = cameras.focal.device
    x = torch.arange(width, dtype=torch.float64, device=device) + 0.5
    y = torch.arange(height, dtype=torch.float64, device=device) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


def _plane(cameras: Cameras, view: Tensor, pixel: Tensor) -> Tensor:
    return (pixel.to(cameras.focal) - cameras.centre[view]) / cameras.focal[view]


def rays_through(
    cameras: Cameras, view: Annotated[Tensor, "R"], pixel: Annotated[Tensor, "R 2"]
) -> tuple[Annotated[Tensor, "R 3"], Annotated[Tensor, "R 3"]]:
    """Origin and unit direction in the world, float64, of the rays through pixels of views; lenses may be mixed.

    A pixel that the lens maps nothing to (see `sees`) gets the outermost direction on its side.
    """
    plane = _plane(cameras, view, pixel)
    local = unbend(cameras.distortion[view], cameras.lens[view], cameras.reach[view], plane)
    pose = cameras.pose[view]
    # OpenCV's lens axes to OpenGL's camera axes: y and z turn round.
    turned = torch.stack([local[:, 0], -local[:, 1], -local[:, 2]], -1)
    direction = (pose[:, :, :3] @ turned[:, :, None])[:, :, 0]
    return pose[:, :, 3].clone(), torch.nn.functional.normalize(direction, dim=-1)


def sees(cameras: Cameras, view: Annotated[Tensor, "R"], pixel: Annotated[Tensor, "R 2"]) -> Annotated[Tensor, "R"]:
    """True where a direction maps to the pixel (to 1e-6 px); false outside of a strongly distorting lens's circle."""
    plane = _plane(cameras, view, pixel)
    distortion, lens, reach = cameras.distortion[view], cameras.lens[view], cameras.reach[view]
    local = unbend(distortion, lens, reach, plane)
    # A direction at the very reach must not fall beyond it by rounding.
    back = bend(distortion, lens, reach * (1 + 1e-9), local)
    miss: Tensor = torch.linalg.vector_norm((back - plane) * cameras.focal[view], dim=-1)
    return torch.le(miss, 1e-6)


def project(
    cameras: Cameras, view: Annotated[Tensor, "R"], points: Annotated[Tensor, "R 3"]
) -> tuple[Annotated[Tensor, "R 2"], Annotated[Tensor, "R"]]:
    """Pixels, and depths along the view's axis, of world points in views, one view a point.

    NaN pixels where the lens cannot see the point (behind it, or beyond its reach). Points that fall outside of the
    image are not marked.
    """
    pose = cameras.pose[view]
    offset = points.to(pose) - pose[:, :, 3]
    local = (pose[:, :, :3].transpose(1, 2) @ offset[:, :, None])[:, :, 0]
    turned = torch.stack([local[:, 0], -local[:, 1], -local[:, 2]], -1)
    plane = bend(cameras.distortion[view], cameras.lens[view], cameras.reach[view], turned)
    return plane * cameras.focal[view] + cameras.centre[view], turned[:, 2]
