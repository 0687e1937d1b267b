"""Views as the rasteriser sees the world: as they are where a lens has one radial term or none, else through
pinholes, which cover what lenses show.

Bringing a photograph to a pinhole costs detail: llff_fern loses 0.13 dB by it (lens.json).

Shapes: views of H W pixels, pinholes of h w. Pixel centres lie at +0.5. Camera axes of the rasteriser are
OpenCV's (x right, y down, z forward), those of `Cameras` OpenGL's.
"""

from functools import lru_cache
from typing import Annotated

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datamanagers.images import Image
from ..ops.rasterise.rendering import Pinhole
from ..ops.rasterise.training import Floats
from ..rendering.cameras import (
    Cameras,
    Intrinsics,
    directions_of,
    intrinsics_of,
    pixel_grid,
    project,
    rays_through,
)
from ..rendering.lens import OPENCV

_MAX_TANGENT = 4.0
"""Tangent of the widest angle that a pinhole shows: 76 degrees; by eye: beyond it pixels become huge."""
_INTERPOLATION = cv2.INTER_LANCZOS4
"""Out of its lens and back into it a photograph of 135 x 240 pixels comes with 43 dB; by cubic interpolation
with 40.
"""
_MIN_RADIAL_SLOPE = 0.5
"""Growth of the radius that is shown with that of the ray, in the corners of a view, above which the rasteriser draws
its lens; by eye: at 0 it folds back.
"""
_BORDER_PIXELS = 2
"""Border of a pinhole's picture, to interpolate in."""


def camera_of(cameras: Cameras, view: int, near: float = 0.01) -> Pinhole:
    """A view without its lens as the rasteriser takes it: OpenCV's axes, world to camera."""
    width, height = cameras.size[view].tolist()
    pose = cameras.pose[view]
    turn = (pose[:, :3] * torch.tensor([1.0, -1.0, -1.0], dtype=pose.dtype)).T
    world_to_camera = torch.eye(4, dtype=torch.float64)
    world_to_camera[:3, :3] = turn
    world_to_camera[:3, 3] = -turn @ pose[:, 3]
    intrinsics = _intrinsics(cameras.focal[view], cameras.centre[view])
    return Pinhole(intrinsics, world_to_camera, width, height, near)


def undistorted(
    cameras: Cameras, view: int, image: Image, camera: Pinhole
) -> tuple[Image, NDArray[np.bool_] | None]:
    """Return the image of a pinhole camera at a view's place, and the part of it that the view shows; None =
    everywhere.

    The image is returned as it is where the view is a pinhole, or drawn with its lens, which `camera` is then taken
    to be.
    """
    if int(cameras.lens[view]) == 0 or camera.k1 != 0:
        return image, None
    pinhole = tuple(camera.intrinsics.flatten().tolist())
    x, y, inside = _places(intrinsics_of(cameras, view), pinhole, camera.width, camera.height)
    return np.asarray(cv2.remap(image, x, y, _INTERPOLATION, borderMode=cv2.BORDER_REPLICATE)), inside


@lru_cache(maxsize=2)
def _places(
    lens: Intrinsics, pinhole: tuple[float, ...], width: int, height: int
) -> tuple[Annotated[Floats, "h w"], Annotated[Floats, "h w"], Annotated[NDArray[np.bool_], "h w"]]:
    """Places in a lens of the pixels of a pinhole with an intrinsic matrix, as `cv2.remap` takes it, and which
    of them it shows.

    Most views of a capture look through one lens.
    """
    # Rays through the pixels of the pinhole, from OpenCV's axes to OpenGL's.
    x = torch.arange(width).double() + 0.5
    y = torch.arange(height).double() + 0.5
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).view(-1, 2)
    matrix = torch.tensor(pinhole, dtype=torch.float64).view(3, 3)
    local = (grid - matrix[:2, 2]) / matrix.diagonal()[:2]
    points = torch.stack([local[:, 0], -local[:, 1], -torch.ones(len(local), dtype=torch.float64)], -1)
    # Where the lens maps them; what falls beyond the outermost pixel centres would only repeat the edge.
    pixel, _ = project(lens.camera(), torch.zeros(len(points), dtype=torch.int64), points)
    place = pixel.view(height, width, 2).numpy()
    inside = (
        np.isfinite(place).all(-1) & (place >= 0.5).all(-1) & (place <= np.array(lens.size) - 0.5).all(-1)
    )
    where = (np.nan_to_num(place, nan=-1e6) - 0.5).astype(np.float32)
    return np.ascontiguousarray(where[..., 0]), np.ascontiguousarray(where[..., 1]), inside


def covering(cameras: Cameras, view: int, near: float) -> Pinhole:
    """The pinhole camera that covers what a view shows: how far a lens reaches, its outermost pixels say."""
    plain = camera_of(cameras, view, near)
    if int(cameras.lens[view]) == 0:
        return plain
    reached = _outermost(intrinsics_of(cameras, view)) * cameras.focal[view]
    # The pinhole keeps the focal length, and has a border of two pixels to interpolate in.
    low = reached.amin(0).floor() - _BORDER_PIXELS
    high = reached.amax(0).ceil() + _BORDER_PIXELS
    wide, tall = (high - low).int().tolist()
    return plain._replace(intrinsics=_intrinsics(cameras.focal[view], -low), width=wide, height=tall)


def drawn_as(cameras: Cameras, view: int, near: float) -> Pinhole:
    """The camera that a view is trained and drawn with: itself where its lens has only k1, else `covering`.

    gsplat draws pinholes alone, so where there is a CUDA device it is `covering` too.
    """
    k1 = float(cameras.distortion[view, 0])
    radial = int(cameras.lens[view]) == OPENCV and not bool(cameras.distortion[view, 1:].any())
    if not radial or k1 == 0 or torch.cuda.is_available():
        return covering(cameras, view, near)
    corner = float(_outermost(intrinsics_of(cameras, view)).square().sum(1).max())
    if 1 + 3 * k1 * corner < _MIN_RADIAL_SLOPE:
        return covering(cameras, view, near)
    return camera_of(cameras, view, near)._replace(k1=k1)


def cover(cameras: Cameras, view: int, near: float) -> tuple[Pinhole, Annotated[Tensor, "H W 2"] | None]:
    """`drawn_as`, and where each of the view's pixels lies in its image; None where it is the view itself."""
    camera = drawn_as(cameras, view, near)
    if int(cameras.lens[view]) == 0 or camera.k1 != 0:
        return camera, None
    width, height = cameras.size[view].tolist()
    tangent = _tangents(directions_of(intrinsics_of(cameras, view), torch.device("cpu")))
    return camera, (tangent * cameras.focal[view] + camera.intrinsics[:2, 2]).view(height, width, 2)


@lru_cache(maxsize=2)
def _outermost(lens: Intrinsics) -> Annotated[Tensor, "N 2"]:
    """Tangents of the rays through a lens's outermost pixels."""
    camera = lens.camera()
    width, height = lens.size
    grid = pixel_grid(camera, 0).view(height, width, 2)
    border = torch.cat([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
    return _tangents(rays_through(camera, torch.zeros(len(border), dtype=torch.int64), border)[1])


def _tangents(direction: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 2"]:
    """Tangents, in OpenCV's axes, of rays in OpenGL's: what lies behind the camera is put at the widest
    angle.
    """
    ahead = (-direction[:, 2]).clamp_min(1e-9)
    return torch.stack([direction[:, 0] / ahead, -direction[:, 1] / ahead], -1).clamp(
        -_MAX_TANGENT, _MAX_TANGENT
    )


def distorted(
    image: Annotated[Tensor, "h w C"], place: Annotated[Tensor, "H W 2"], *, linear: bool = False
) -> Annotated[Tensor, "H W C"]:
    """An image at the places of `cover`; `linear` for what must not swing over its edges."""
    x, y = np.ascontiguousarray((place.numpy() - 0.5).astype(np.float32).transpose(2, 0, 1))
    interpolation = cv2.INTER_LINEAR if linear else _INTERPOLATION
    sampled = cv2.remap(np.ascontiguousarray(image), x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(np.atleast_3d(sampled))


def _intrinsics(focal: Annotated[Tensor, "2"], centre: Annotated[Tensor, "2"]) -> Annotated[Tensor, "3 3"]:
    out = torch.eye(3, dtype=torch.float64)
    out[[0, 1], [0, 1]] = focal.double()
    out[:2, 2] = centre.double()
    return out
