"""Calibrated views and the rays through their pixels.

World metres (or whatever unit the capture has), float64 throughout: the space that fields live in is
recentred from it. Axes are OpenGL's: x right, y up, the camera looks along -z. Pixel centres lie at +0.5.

Undistortion takes a dozen Newton steps a pixel; training asks for the same pixels over and over. Captures
with one camera need one table (24 bytes a pixel). Above `LIMIT` bytes, for thousands of different lenses,
rays are solved as they come.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from .lens import PINHOLE, bend, lens_reach, unbend


@dataclass(frozen=True)
class Cameras:
    """V views. `lens` is 0 pinhole, 1 OpenCV (k1..k4 radial, p1 p2 tangential), 2 fisheye (equidistant,
    k1..k4).
    """

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
        """Limit up to which each lens maps one to one: radius at depth 1, or a fisheye's angle; infinite for
        a pinhole.
        """
        return lens_reach(self.distortion, self.lens)

    def select(self, index: Annotated[Tensor, "M"]) -> "Cameras":
        """Some of the views, in the order of `index` (int64, or a mask of all)."""
        return Cameras(*(getattr(self, field.name)[index] for field in fields(self)))

    def to(self, device: torch.device) -> "Cameras":
        """The same views, their numbers on a device."""
        return Cameras(*(getattr(self, field.name).to(device) for field in fields(self)))

    def shifted(self, offset: Sequence[float]) -> "Cameras":
        """The same views with this added to their places, in world axes."""
        place = self.pose[:, :, 3:] + torch.tensor(offset).to(self.pose)[:, None]
        return replace(self, pose=torch.cat([self.pose[:, :, :3], place], 2))

    def resized(self, size: Annotated[Tensor, "V 2"]) -> "Cameras":
        """The same views on another pixel grid: intrinsics move by the exact ratio of each axis."""
        ratio = size.to(self.focal) / self.size.to(self.focal)
        return replace(self, focal=self.focal * ratio, centre=self.centre * ratio, size=size.to(self.size))

    def scaled(self, downscale: Annotated[Tensor, "V 1"] | float) -> "Cameras":
        """The same views at 1/downscale of their size, rounded to whole pixels and at least one."""
        return self.resized((self.size.double() / downscale).round().clamp_min(1))


def ideal_cameras(pose: Annotated[Tensor, "V 3 4"], focal: Tensor | float, size: tuple[int, int]) -> Cameras:
    """Pinhole views of one size (width, height) without distortion, the principal point in the middle, pixels
    square.

    `focal` in pixels is one number, or one for each view.
    """
    count = len(pose)
    sides = torch.tensor(size)
    return Cameras(
        pose=pose,
        focal=torch.as_tensor(focal, dtype=torch.float64).reshape(-1, 1).expand(count, 2).clone(),
        centre=(sides.double() / 2).repeat(count, 1),
        size=sides.repeat(count, 1),
        distortion=torch.zeros(count, 6, dtype=torch.float64),
        lens=torch.full((count,), PINHOLE),
    )


def pixel_grid(cameras: Cameras, view: int) -> Annotated[Tensor, "N 2"]:
    """All N = H * W pixel centres of a view, row by row, float64: x in [0.5, W - 0.5], y in [0.5, H -
    0.5].
    """
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
    """Origin and unit direction in the world, float64, of the rays through pixels of views; lenses may be
    mixed.

    A pixel that the lens maps nothing to gets the outermost direction on its side.
    """
    plane = _plane(cameras, view, pixel)
    # From pixels to the plane at depth 1, through the lens, into the world.
    local = unbend(cameras.distortion[view], cameras.lens[view], cameras.reach[view], plane)
    pose = cameras.pose[view]
    # OpenCV's lens axes to OpenGL's camera axes: y and z turn round.
    turned = torch.stack([local[:, 0], -local[:, 1], -local[:, 2]], -1)
    direction = (pose[:, :, :3] @ turned[:, :, None])[:, :, 0]
    return pose[:, :, 3].clone(), torch.nn.functional.normalize(direction, dim=-1)


def project(
    cameras: Cameras, view: Annotated[Tensor, "R"], points: Annotated[Tensor, "R 3"]
) -> tuple[Annotated[Tensor, "R 2"], Annotated[Tensor, "R"]]:
    """Pixels, and depths along the view's axis, of world points in views, one view a point.

    NaN pixels where the lens cannot see the point (behind it, or beyond its reach). Points that fall outside
    of the image are not marked.
    """
    pose = cameras.pose[view]
    offset = points.to(pose) - pose[:, :, 3]
    local = (pose[:, :, :3].transpose(1, 2) @ offset[:, :, None])[:, :, 0]
    turned = torch.stack([local[:, 0], -local[:, 1], -local[:, 2]], -1)
    plane = bend(cameras.distortion[view], cameras.lens[view], cameras.reach[view], turned)
    return plane * cameras.focal[view] + cameras.centre[view], turned[:, 2]


def look_up(image: Annotated[Tensor, "H W C"], pixel: Annotated[Tensor, "N 2"]) -> Annotated[Tensor, "N C"]:
    """Bilinear values at pixels, whose centres lie at +0.5, in their dtype; beside the image those of its
    border.
    """
    place = 2 * pixel / pixel.new_tensor([image.shape[1], image.shape[0]]) - 1
    return F.grid_sample(
        image.to(place).permute(2, 0, 1)[None],
        place[None, None],
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )[0, :, 0].T


LIMIT = 256 * 2**20
"""Bytes of tables that are kept at most."""


class PixelRays:
    """`rays_through` for pixels at their centres (+0.5), equal to it within float64 rounding.

    Directions are kept for each kind of lens, up to `limit` bytes; those of pinholes beyond it are found
    without iteration.
    """

    def __init__(self, cameras: Cameras, *, limit: int = LIMIT) -> None:
        self.cameras = cameras
        self.pinholes = bool((cameras.lens == PINHOLE).all())
        # Views with one lens share a table: most captures have one camera.
        described = torch.cat(
            [
                cameras.focal,
                cameras.centre,
                cameras.distortion,
                cameras.size.double(),
                cameras.lens[:, None].double(),
            ],
            -1,
        )
        kinds, self.kind = torch.unique(described, dim=0, return_inverse=True)
        parts = []
        for k in range(len(kinds)):
            parts.append((self.kind == k).nonzero()[0, 0])
        first = torch.stack(parts)
        area = cameras.size[first].prod(-1)
        self.start = area.cumsum(0) - area
        self.table: Tensor | None = None
        if int(area.sum()) * 24 <= limit:
            parts = []
            for view in first:
                parts.append(directions_of(intrinsics_of(cameras, int(view)), cameras.pose.device))
            self.table = torch.cat(parts)

    @property
    def waits(self) -> bool:
        """True where an accelerator would make the host wait: lenses beyond the limit are inverted by
        iteration.
        """
        return self.table is None and not self.pinholes

    @property
    def device(self) -> torch.device:
        """Device on which rays are made; views and pixels must be on it."""
        return self.start.device

    def to(self, device: torch.device) -> "PixelRays":
        """Move to a device."""
        self.cameras = self.cameras.to(device)
        self.kind = self.kind.to(device)
        self.start = self.start.to(device)
        self.table = None if self.table is None else self.table.to(device)
        return self

    def __call__(
        self, view: Annotated[Tensor, "R"], pixel: Annotated[Tensor, "R 2"]
    ) -> tuple[Annotated[Tensor, "R 3"], Annotated[Tensor, "R 3"]]:
        """Origin and unit direction in the world, float64."""
        if self.table is not None:
            x, y = pixel.long().unbind(-1)
            local = self.table[self.start[self.kind[view]] + y * self.cameras.size[view, 0] + x]
        elif self.pinholes:
            x, y = _plane(self.cameras, view, pixel).unbind(-1)
            local = torch.nn.functional.normalize(torch.stack([x, -y, -torch.ones_like(x)], -1), dim=-1)
        else:
            return rays_through(self.cameras, view, pixel)
        pose = self.cameras.pose[view]
        return pose[:, :, 3], (pose[:, :, :3] @ local[:, :, None])[:, :, 0]


def grid_rays(
    cameras: Cameras, view: int, device: torch.device | None = None
) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N 3"]]:
    """`rays_through` all pixels of a view (`pixel_grid`), within float64 rounding; on a device, else where
    the cameras lie.

    The frames of a path, and mostly the views of a capture, look through one lens: the last two are
    remembered.
    """
    pose = cameras.pose[view].to(device)
    direction = directions_of(intrinsics_of(cameras, view), pose.device) @ pose[:, :3].T
    return pose[:, 3].expand_as(direction), direction


class Intrinsics(NamedTuple):
    """A view without its pose, as plain numbers, which a cache can compare."""

    focal: tuple[float, ...]
    centre: tuple[float, ...]
    distortion: tuple[float, ...]
    size: tuple[int, ...]
    lens: int

    def camera(self) -> Cameras:
        """One view with these intrinsics, at the origin, looking along -z."""
        still = torch.cat([torch.eye(3, dtype=torch.float64), torch.zeros(3, 1, dtype=torch.float64)], 1)
        focal, centre, distortion = (torch.tensor([x], dtype=torch.float64) for x in self[:3])
        return Cameras(
            still[None], focal, centre, torch.tensor([self.size]), distortion, torch.tensor([self.lens])
        )


def intrinsics_of(cameras: Cameras, view: int) -> Intrinsics:
    """Intrinsics of a view."""
    focal = tuple(cameras.focal[view].tolist())
    centre = tuple(cameras.centre[view].tolist())
    distortion = tuple(cameras.distortion[view].tolist())
    return Intrinsics(focal, centre, distortion, tuple(cameras.size[view].tolist()), int(cameras.lens[view]))


@lru_cache(maxsize=2)
def directions_of(intrinsics: Intrinsics, device: torch.device) -> Annotated[Tensor, "N 3"]:
    """Unit directions in camera axes, float64, through all pixels of a view (`pixel_grid`)."""
    camera = intrinsics.camera()
    pixel = pixel_grid(camera, 0)
    return rays_through(camera, torch.zeros(len(pixel), dtype=torch.int64), pixel)[1].to(device)


def normals(cameras: Cameras, view: int, depth: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "H W 3"]:
    """Unit normals in world axes, facing the camera; 0 where depth is not positive and finite, or there is no
    neighbour.

    `depth` is the distance along the unit ray. Of the two neighbours in each direction the nearer one in
    space counts, so that an edge belongs to one of its sides.
    """
    origin, direction = grid_rays(cameras, view)
    height, width = depth.shape
    solid = torch.isfinite(depth) & (depth > 0)
    far = torch.where(solid, depth, torch.zeros_like(depth)).double()
    points = origin.view(height, width, 3) + direction.view(height, width, 3) * far[..., None]
    # Steps follow the pixels' order, so that of what a camera sees they turn as its pixels do: the normal
    # faces it. Where there is no step the product is 0, and stays so.
    normal = torch.linalg.cross(_step(points, solid, 0), _step(points, solid, 1))
    return torch.nn.functional.normalize(normal, dim=-1, eps=1e-300).float()


def _step(points: Tensor, solid: Tensor, axis: int) -> Tensor:
    """Steps to each point's next one along an axis, or from the one before, whichever is shorter; 0 where
    there is none.
    """
    count = points.shape[axis]
    both = (solid.narrow(axis, 1, count - 1) & solid.narrow(axis, 0, count - 1))[..., None]
    gaps = points.narrow(axis, 1, count - 1) - points.narrow(axis, 0, count - 1)
    gaps = torch.where(both, gaps, torch.full_like(gaps, torch.inf))
    edge = torch.full_like(points.narrow(axis, 0, 1), torch.inf)
    ahead = torch.cat([gaps, edge], axis)
    behind = torch.cat([edge, gaps], axis)
    shorter = ahead.norm(dim=-1, keepdim=True) <= behind.norm(dim=-1, keepdim=True)
    step = torch.where(shorter, ahead, behind)
    return torch.where(torch.isfinite(step), step, torch.zeros_like(step))
