"""Rays through pixel centres, again and again: what a lens does to them is solved once and looked up ever after.

Undistortion takes a dozen Newton steps a pixel; training asks for the same pixels over and over. Captures with one camera
need one table (24 bytes a pixel). Above `LIMIT` bytes, for thousands of different lenses, rays are solved as they come.
"""

from functools import lru_cache
from typing import Annotated

import torch
from torch import Tensor

from .cameras import Cameras, pixel_grid, rays_through

__all__ = ["LIMIT", "PixelRays", "grid_rays"]

LIMIT = 256 * 2**20
"""Bytes of tables that are kept at most."""


class PixelRays:
    """`rays_through` for pixels at their centres (+0.5), equal to it within float64 rounding."""

    def __init__(self, cameras: Cameras, *, limit: int = LIMIT) -> None:
        self.cameras = cameras
        described = torch.cat(
            [cameras.focal, cameras.centre, cameras.distortion, cameras.size.double(), cameras.lens[:, None].double()], -1
        )
        kinds, self.kind = torch.unique(described, dim=0, return_inverse=True)
        first = torch.stack([(self.kind == k).nonzero()[0, 0] for k in range(len(kinds))])
        area = cameras.size[first].prod(-1)
        self.start = area.cumsum(0) - area
        self.table: Tensor | None = None
        if int(area.sum()) * 24 <= limit:
            self.table = torch.cat([self._solve(int(view)) for view in first])

    @property
    def device(self) -> torch.device:
        """Device on which rays are made; views and pixels must be on it."""
        return self.start.device

    def to(self, device: torch.device) -> "PixelRays":
        """Move to a device."""
        self.cameras, self.kind, self.start = self.cameras.to(device), self.kind.to(device), self.start.to(device)
        self.table = None if self.table is None else self.table.to(device)
        return self

    def __call__(
        self, view: Annotated[Tensor, "R"], pixel: Annotated[Tensor, "R 2"]
    ) -> tuple[Annotated[Tensor, "R 3"], Annotated[Tensor, "R 3"]]:
        """Origin and unit direction in the world, float64."""
        if self.table is None:
            return rays_through(self.cameras, view, pixel)
        x, y = pixel.long().unbind(-1)
        local = self.table[self.start[self.kind[view]] + y * self.cameras.size[view, 0] + x]
        pose = self.cameras.pose[view]
        return pose[:, :, 3], (pose[:, :, :3] @ local[:, :, None])[:, :, 0]

    def _solve(self, view: int) -> Annotated[Tensor, "P 3"]:
        """Unit directions in camera axes of all pixels of a view."""
        pixel = pixel_grid(self.cameras, view)
        _, world = rays_through(self.cameras, torch.full((len(pixel),), view), pixel)
        return world @ self.cameras.pose[view, :, :3]


def grid_rays(
    cameras: Cameras, view: int, device: torch.device | None = None
) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N 3"]]:
    """`rays_through` all pixels of a view (`pixel_grid`), within float64 rounding; on a device, else where the cameras lie.

    The frames of a path, and mostly the views of a capture, look through one lens: the last two are remembered.
    """
    numbers = (cameras.focal, cameras.centre, cameras.distortion)
    width, height = cameras.size[view].tolist()
    pose = cameras.pose[view].to(device)
    local = _local(*(tuple(x[view].tolist()) for x in numbers), width, height, int(cameras.lens[view]), pose.device)
    direction = local @ pose[:, :3].T
    return pose[:, 3].expand_as(direction), direction


@lru_cache(maxsize=2)
def _local(
    focal: tuple[float, ...],
    centre: tuple[float, ...],
    distortion: tuple[float, ...],
    width: int,
    height: int,
    lens: int,
    device: torch.device,
) -> Annotated[Tensor, "N 3"]:
    """Unit directions in camera axes: a function of the lens alone."""
    still = torch.cat([torch.eye(3, dtype=torch.float64), torch.zeros(3, 1, dtype=torch.float64)], 1)
    focals, centres, bends = (torch.tensor([x], dtype=torch.float64) for x in (focal, centre, distortion))
    camera = Cameras(still[None], focals, centres, torch.tensor([[width, height]]), bends, torch.tensor([lens]))
    pixel = pixel_grid(camera, 0)
    return rays_through(camera, torch.zeros(len(pixel), dtype=torch.int64), pixel)[1].to(device)
