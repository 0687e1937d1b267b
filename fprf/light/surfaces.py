"""Surfaces that Gaussians show: a point and a normal of each, found in views.

A view has a disparity (1 / depth) at each pixel, and how sure it is: less where what is blended there lies at
several depths, or in Gaussians that are long along the ray, as where nothing with texture held them in place.
On a plane disparity is an affine function of the pixel. So each pixel takes the plane that fits the sure ones
around it, in the smallest window that holds enough of them: what is unsure, such as bare asphalt, takes the
plane of the markings around it. Points and normals are then carried back to the Gaussians by their weights, times
a confidence: where no plane fits the pixels around, as at outlines, they say little.

Shapes: N Gaussians, views of H W pixels. Camera axes are OpenCV's.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..ops.rasterise.rendering import Pinhole, lift, rasterise
from .transport import axes_of

_SURE_DEVIATION = 0.07
"""Relative deviation of the depth of a pixel at which it counts a quarter of a sure one. On the town's road, whose
Gaussians lie up to twice as deep as it, 0.05 to 0.07 find the plane of its markings, 0.2 does not.
"""
_RADII = (2, 4, 8, 16, 32, 64)
"""Of the windows, in pixels of a view 320 wide."""
_ENOUGH_PIXELS = 20.0
"""Sure pixels in a window that tell a plane."""
_MAX_OWN_DEVIATION = 3.0
"""Relative depth of a Gaussian along the ray, from which on more makes no difference."""
_MISFIT_SHARE = 0.02
"""Relative deviation of disparities from their plane at which a pixel's confidence is a sixteenth of that of one
that fits, which is (1 + deviation / share)^-4. On the town 0.01 to 0.05 do alike; the exponents 2 and 8 are 0.3 and
0.1 dB worse.
"""
_RIDGE_PIXELS = 0.3
"""Deviation of pixels added to that in a window, below which there is no slope to be found."""
_MIN_SEEN_PIXELS = 1e-2
"""Weight of a Gaussian in all views, from which on they say something about it."""
_MAX_DISTANCE = 1000.0
"""Distance that planes are cut at, in median ones: beyond is the horizon."""


class Surfaces(NamedTuple):
    """Surfaces of N Gaussians."""

    points: Annotated[Tensor, "N 3"]
    """Points of the surface that they show; their means, where no view shows them."""
    normals: Annotated[Tensor, "N 3"]
    """Unit normals, out of the surface."""
    sure: Annotated[Tensor, "N"]
    """Agreement of the normals of all pixels that show a Gaussian, in [0, 1]; 0 where no view shows it."""
    widths: Annotated[Tensor, "N"]
    """Width of the view where they are: of what size details can be told there."""
    weights: Annotated[Tensor, "N"]
    """Pixels that they weigh in all views."""


class _Map(NamedTuple):
    """The surface at the pixels of a view."""

    points: Annotated[Tensor, "H W 3"]
    normals: Annotated[Tensor, "H W 3"]
    widths: Annotated[Tensor, "H W"]
    confidence: Annotated[Tensor, "H W"]
    """In (0, 1]."""


@torch.inference_mode()
def find_surfaces(
    means: Annotated[Tensor, "N 3"],
    quaternions: Annotated[Tensor, "N 4"],
    log_scales: Annotated[Tensor, "N 3"],
    logits: Annotated[Tensor, "N"],
    cameras: Sequence[Pinhole],
    *,
    up: Annotated[Tensor, "3"],
    antialiased: bool = False,
) -> Surfaces:
    """The surfaces that Gaussians show in views; where none shows them, normals point `up` and count nothing."""
    middle = means.mean(0)
    shape = (quaternions, log_scales, logits)
    axes = axes_of(quaternions)
    up = up.to(means)
    sums = means.new_zeros(len(means), 9)
    for camera in cameras:
        here = _about(camera, middle)
        at = means - middle
        found = _view_surface(at, axes, shape, here, antialiased)
        ones = torch.ones_like(found.widths)[..., None]
        pixels = torch.cat([found.normals, found.points, found.widths[..., None], ones], -1)
        pixels = torch.cat([found.confidence[..., None] * pixels, ones], -1)
        sums += lift(at, *shape, here, pixels.contiguous(), antialiased=antialiased)
    weight = sums[:, 8]
    seen = weight > _MIN_SEEN_PIXELS
    part = torch.where(seen, sums[:, 7], 1.0)[:, None]
    sure = torch.where(seen, (sums[:, :3] / part).norm(dim=1).clamp(0, 1), torch.zeros(()))
    normals = torch.where(seen[:, None], torch.nn.functional.normalize(sums[:, :3], dim=1), up)
    points = torch.where(seen[:, None], sums[:, 3:6] / part + middle, means)
    usual = (sums[:, 6] / part[:, 0])[seen].median() if bool(seen.any()) else torch.ones(())
    widths = torch.where(seen, sums[:, 6] / part[:, 0], usual)
    return Surfaces(points, normals, sure, widths, weight)


def _about(camera: Pinhole, middle: Annotated[Tensor, "3"]) -> Pinhole:
    """The camera in a world whose origin is `middle`."""
    world = camera.world_to_camera.clone()
    world[:3, 3] += world[:3, :3] @ middle.to(world)
    return camera._replace(world_to_camera=world)


def _view_surface(
    means: Annotated[Tensor, "N 3"],
    axes: Annotated[Tensor, "N 3 3"],
    shape: tuple[Tensor, Tensor, Tensor],
    camera: Pinhole,
    antialiased: bool,
) -> _Map:
    """Points and normals at the pixels of a view."""
    world = camera.world_to_camera.to(means)
    eye = -world[:3, :3].T @ world[:3, 3]
    ray = means - eye
    depth = (ray @ world[2, :3]).clamp_min(camera.near)
    # How long a Gaussian is along the ray, as a share of its distance.
    ray = torch.nn.functional.normalize(ray, dim=1)
    sizes = shape[1].exp().clamp_min(1e-12)
    along = torch.einsum("na,nab->nb", ray, axes) / sizes
    own = (1 / along.norm(dim=1).clamp_min(1e-12) / depth).clamp_max(_MAX_OWN_DEVIATION)
    values = torch.stack([1 / depth, 1 / depth.square(), own], 1)
    harmonics = means.new_zeros(len(means), 1, 3)
    drawn = rasterise(means, *shape, harmonics, camera, features=values, antialiased=antialiased)
    inside = drawn.features / drawn.opacity.clamp_min(1e-4)[..., None]
    disparity = inside[..., 0]
    spread = (inside[..., 1] - disparity.square()).clamp_min(0) / disparity.square().clamp_min(1e-20)
    deviation = (spread + inside[..., 2].square()) / _SURE_DEVIATION**2
    sure = drawn.opacity.square() / (1 + deviation).square()
    plane = torch.from_numpy(_fitted_planes(disparity.cpu().numpy(), sure.cpu().numpy())).to(means)
    # Where nothing is opaque, all is as faint, and counts.
    solid = drawn.opacity > drawn.opacity.max() / 2
    usual = float(1 / disparity[solid].median().clamp_min(1e-9)) if bool(solid.any()) else 1.0
    return _on_planes(plane, camera, usual, world)


def _on_planes(plane: Annotated[Tensor, "H W 4"], camera: Pinhole, usual: float, world: Tensor) -> _Map:
    """Points and normals in the world of the planes disparity = a x + b y + c about each pixel, x and y in
    pixels; the last is the variance of disparities about it.
    """
    height, width = plane.shape[:2]
    k = camera.intrinsics.to(plane)
    rows = torch.arange(height, device=plane.device) + 0.5
    columns = torch.arange(width, device=plane.device) + 0.5
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    tangent_x = (x - k[0, 2]) / k[0, 0]
    tangent_y = (y - k[1, 2]) / k[1, 1]
    # With tangents u and v: 1 / z = a fx u + b fy v + d, so that a fx X + b fy Y + d Z = 1 is the plane.
    a = plane[..., 0] * k[0, 0]
    b = plane[..., 1] * k[1, 1]
    d = plane[..., 2] - a * tangent_x - b * tangent_y
    normal = -torch.nn.functional.normalize(torch.stack([a, b, d], -1), dim=-1)
    depth = 1 / plane[..., 2].clamp_min(1 / (_MAX_DISTANCE * usual))
    local = torch.stack([tangent_x * depth, tangent_y * depth, depth], -1)
    misfit = plane[..., 3].sqrt() * depth
    return _Map(
        (local - world[:3, 3]) @ world[:3, :3],
        normal @ world[:3, :3],
        depth * (width / float(k[0, 0])),
        (1 + misfit.clamp_max(1.0) / _MISFIT_SHARE).pow(-4),
    )


_Pixels = NDArray[np.float32]


def _fitted_planes(disparity: _Pixels, sure: _Pixels) -> _Pixels:
    """The weighted least squares a, b, c of disparity = a x + b y + c about each pixel, and the variance that is
    left [H W 4].
    """
    height, width = disparity.shape
    y, x = np.meshgrid(
        np.arange(height, dtype=np.float32) - height / 2,
        np.arange(width, dtype=np.float32) - width / 2,
        indexing="ij",
    )
    first = np.stack([sure, sure * x, sure * y, sure * disparity], -1)
    second = np.stack(
        [first[..., 1] * x, first[..., 1] * y, first[..., 2] * y, first[..., 3] * disparity], -1
    )
    third = np.stack([first[..., 3] * x, first[..., 3] * y, np.zeros_like(x), np.zeros_like(x)], -1)
    out = np.zeros((height, width, 4), np.float32)
    left = np.ones((height, width), np.bool_)
    for level, radius in enumerate(_RADII):
        reach = max(1, round(radius * width / 320))
        size = (2 * reach + 1, 2 * reach + 1)
        one, two, three = (
            cv2.blur(part.astype(np.float64), size, borderType=cv2.BORDER_CONSTANT)
            for part in (first, second, third)
        )
        amount = np.maximum(one[..., 0], 1e-12)
        mx = one[..., 1] / amount
        my = one[..., 2] / amount
        mean = one[..., 3] / amount
        xx = two[..., 0] / amount - mx * mx
        xy = two[..., 1] / amount - mx * my
        yy = two[..., 2] / amount - my * my
        xd = three[..., 0] / amount - mx * mean
        yd = three[..., 1] / amount - my * mean
        dd = two[..., 3] / amount - mean * mean
        told = left & (one[..., 0] * size[0] * size[1] > _ENOUGH_PIXELS) & (np.minimum(xx, yy) > 0.25)
        if level == len(_RADII) - 1:
            told = left
        xx = xx + _RIDGE_PIXELS**2
        yy = yy + _RIDGE_PIXELS**2
        determinant = xx * yy - xy * xy
        a = (yy * xd - xy * yd) / determinant
        b = (xx * yd - xy * xd) / determinant
        rest = np.maximum(dd - a * xd - b * yd, 0)
        fitted = np.stack([a, b, mean + a * (x - mx) + b * (y - my), rest], -1)
        out[told] = fitted[told]
        left &= ~told
        if not left.any():
            break
    return out
