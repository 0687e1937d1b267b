"""The rasteriser of 3D Gaussians in plain torch: any device, any float type, gradients by autograd.

Letters: N Gaussians, K harmonics of a colour channel (1, 4, 9 or 16), C feature channels, H W pixels.

    Sigma = J W (R S)(R S)^T W^T J^T + 0.3 I      alpha_i(x) = o_i exp(-(x - m_i)^T Sigma_i^-1 (x - m_i) / 2), at most 0.99
    image = sum_i alpha_i T_i v_i + T_N background      T_i = prod_j<i (1 - alpha_j), front to back by the depth of the means

alpha below 1/255 counts as 0. With `antialiased` o_i is multiplied by sqrt(det(Sigma - 0.3 I) / det Sigma):
what the blur widens it makes fainter (Mip-Splatting). J is the projection's derivative at the mean, its
tangents limited to 15 % beyond the image's edges, as in the published code. A camera with radial distortion k1 shows
the tangents (u, v) at (u, v) (1 + k1 (u^2 + v^2)), up to where that grows no more; J has the derivative of that too.
"""

import math
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..harmonics import spherical_harmonics
from . import BLUR, MAX_ALPHA, MAX_COORDINATE, MAX_LOG, MAX_SQUARE_PIXELS, MIN_ALPHA, TANGENT_MARGIN

TILE = 16
"""Pixels of a tile's side, as in the kernels."""
_MIN_NORM = 1e-12
"""Length below which a quaternion is not made longer; float32 squares it to 1e-24."""
_SLOPE_EPSILON = 1e-8
"""Added under the root of anti-aliasing, which then has a finite slope at 0."""
_MIN_REACH = 1e-30
"""Opacity over MIN_ALPHA below which its logarithm is no longer taken; above float32's smallest number."""


class Pinhole(NamedTuple):
    """A camera without distortion, or with a radial one; a constant: nothing has a gradient in it."""

    intrinsics: Annotated[Tensor, "3 3"]
    """fx, fy, cx, cy in pixels, pixel centres at +0.5; no skew."""
    world_to_camera: Annotated[Tensor, "4 4"]
    """Camera axes are OpenCV's: x right, y down, z forward."""
    width: int
    height: int
    near: float = 0.01
    """World distance along z up to which nothing is drawn."""
    k1: float = 0.0
    """Radial distortion: tangents r from the axis are shown at r (1 + k1 r^2)."""


class Projected(NamedTuple):
    """N Gaussians on the image plane."""

    mean: Annotated[Tensor, "N 2"]
    covariance: Annotated[Tensor, "N 3"]
    """xx, xy, yy in square pixels, blur included."""
    determinant: Annotated[Tensor, "N"]
    depth: Annotated[Tensor, "N"]
    opacity: Annotated[Tensor, "N"]
    extent: Annotated[Tensor, "N 2"]
    """Half width and height of the ellipse where alpha is 1/255; -1 where nothing is drawn."""


def view_colours(
    means: Annotated[Tensor, "N 3"], harmonics: Annotated[Tensor, "N K 3"], camera: Pinhole
) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N"]]:
    """Colours from 0 on as a camera sees them, and which of them are finite; the others are of harmonics
    0.
    """
    pose = camera.world_to_camera.to(means)
    fine = (means.abs() < MAX_COORDINATE).all(-1) & (harmonics.abs() < MAX_COORDINATE).flatten(1).all(-1)
    direction = torch.where(fine[:, None], means, torch.zeros_like(means)) + pose[:3, :3].T @ pose[:3, 3]
    harmonics = torch.where(fine[:, None, None], harmonics, torch.zeros_like(harmonics))
    basis = spherical_harmonics(
        torch.nn.functional.normalize(direction, dim=-1), math.isqrt(harmonics.shape[1])
    )
    return ((basis[..., None] * harmonics).sum(1) + 0.5).clamp_min(0), fine


def project_reference(
    means: Annotated[Tensor, "N 3"],
    quaternions: Annotated[Tensor, "N 4"],
    log_scales: Annotated[Tensor, "N 3"],
    logits: Annotated[Tensor, "N"],
    camera: Pinhole,
    *,
    antialiased: bool,
) -> Projected:
    """Gaussians on the image plane; those with NaN, means beyond 1e15 or more than 1e8 pixels wide are not
    drawn.
    """
    world = camera.world_to_camera.to(means)
    fx, fy, cx, cy = (float(camera.intrinsics[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    # What is not finite would spoil the gradients of all others: harmless numbers take its place, and it is
    # not drawn.
    shape = torch.cat([quaternions, log_scales, logits[:, None]], -1)
    fine = (
        (means.abs() < MAX_COORDINATE).all(-1)
        & (quaternions.abs() < MAX_COORDINATE).all(-1)
        & ~shape.isnan().any(-1)
    )
    means, quaternions = (torch.where(fine[:, None], x, torch.ones_like(x)) for x in (means, quaternions))
    log_scales = torch.where(fine[:, None], log_scales, torch.zeros_like(log_scales)).clamp(-MAX_LOG, MAX_LOG)
    logits = torch.where(fine, logits, torch.zeros_like(logits)).clamp(-MAX_LOG, MAX_LOG)
    # Tangents of the means. Far outside the image J would explode: its tangents alone are limited, the means
    # are not.
    x, y, depth = (means @ world[:3, :3].T + world[:3, 3]).unbind(-1)
    z = torch.where(depth > camera.near, depth, torch.ones_like(depth))
    u = x / z
    v = y / z
    beyond_u = TANGENT_MARGIN * camera.width / fx
    beyond_v = TANGENT_MARGIN * camera.height / fy
    limited_u = u.clamp(-cx / fx - beyond_u, (camera.width - cx) / fx + beyond_u)
    limited_v = v.clamp(-cy / fy - beyond_v, (camera.height - cy) / fy + beyond_v)
    # Rows of J W R S: the half axes in pixels, whose products are the covariance.
    qw, qx, qy, qz = torch.nn.functional.normalize(quaternions, dim=-1, eps=_MIN_NORM).unbind(-1)
    rows = [
        1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy),
        2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx),
        2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy),
    ]  # fmt: skip
    axes = world[:3, :3] @ torch.stack(rows, -1).view(-1, 3, 3) * log_scales.exp()[:, None]
    plain_across = axes[:, 0] - limited_u[:, None] * axes[:, 2]
    plain_down = axes[:, 1] - limited_v[:, None] * axes[:, 2]
    # The derivative of u (1 + k1 r^2) and v (1 + k1 r^2) by u and v.
    bend_uu = 1 + camera.k1 * (3 * limited_u.square() + limited_v.square())
    bend_uv = 2 * camera.k1 * limited_u * limited_v
    bend_vv = 1 + camera.k1 * (limited_u.square() + 3 * limited_v.square())
    across = (fx / z)[:, None] * (bend_uu[:, None] * plain_across + bend_uv[:, None] * plain_down)
    down = (fy / z)[:, None] * (bend_uv[:, None] * plain_across + bend_vv[:, None] * plain_down)
    fine = fine & (across.square().sum(-1) + down.square().sum(-1) < MAX_SQUARE_PIXELS)
    across, down = (torch.where(fine[:, None], x, torch.ones_like(x)) for x in (across, down))
    xx = across.square().sum(-1)
    yy = down.square().sum(-1)
    xy = (across * down).sum(-1)
    # The determinant as the square of a cross product: xx yy - xy^2 would lose the digits of thin ellipses.
    det_sharp = torch.linalg.cross(across, down).square().sum(-1)
    det_blurred = det_sharp + BLUR * (xx + yy) + BLUR**2
    opacity = torch.sigmoid(logits)
    if antialiased:
        opacity = opacity * (det_sharp / det_blurred + _SLOPE_EPSILON).sqrt()  # Mip-Splatting, Eq. 9
    covariance = torch.stack([xx + BLUR, xy, yy + BLUR], -1)
    square = u * u + v * v
    stretch = 1 + camera.k1 * square
    mean = torch.stack([fx * (u * stretch) + cx, fy * (v * stretch) + cy], -1)
    # Where alpha falls to 1/255: x^T Sigma^-1 x = 2 ln(255 o).
    reach = 2 * (opacity.detach() / MIN_ALPHA).clamp_min(_MIN_REACH).log()
    extent = (reach.clamp_min(0)[:, None] * covariance.detach()[:, ::2]).sqrt()
    seen = fine & (depth > camera.near) & (reach > 0) & (1 + 3 * camera.k1 * square > 0)
    extent = torch.where(seen[:, None], extent, -torch.ones_like(extent))
    return Projected(mean, covariance, det_blurred, depth, opacity, extent)


def rasterise_reference(
    means: Annotated[Tensor, "N 3"],
    quaternions: Annotated[Tensor, "N 4"],
    log_scales: Annotated[Tensor, "N 3"],
    logits: Annotated[Tensor, "N"],
    values: Annotated[Tensor, "N C"],
    camera: Pinhole,
    background: Annotated[Tensor, "C"],
    *,
    antialiased: bool,
) -> tuple[Annotated[Tensor, "H W C+1"], Annotated[Tensor, "H W"]]:
    """Composited values, the composited depth behind them [H W C+1], and the transmittance left."""
    splats = project_reference(means, quaternions, log_scales, logits, camera, antialiased=antialiased)
    values = torch.cat([values, splats.depth[:, None]], -1)
    # Front to back, without those that are not drawn.
    shown = splats.extent[:, 0] > 0
    order = splats.depth.detach().masked_fill(~shown, torch.inf).argsort(stable=True)[: int(shown.sum())]
    splats = Projected(*(x[order] for x in splats))
    values = values[order]
    behind = torch.cat([background, background.new_zeros(1)])
    rows = []
    for top in range(0, camera.height, TILE):
        vertical = (top, min(top + TILE, camera.height))
        tiles = []
        for left in range(0, camera.width, TILE):
            horizontal = (left, min(left + TILE, camera.width))
            tiles.append(_tile(splats, values, behind, vertical, horizontal))
        rows.append(torch.cat(tiles, 1))
    image = torch.cat(rows)
    return image[..., :-1], image[..., -1]


def _tile(
    splats: Projected,
    values: Tensor,
    background: Tensor,
    vertical: tuple[int, int],
    horizontal: tuple[int, int],
) -> Annotated[Tensor, "h w C+2"]:
    """Values, depth and transmittance of the pixels between two rows and two columns."""
    # Those that reach into the tile, front to back as before.
    (top, bottom) = vertical
    (left, right) = horizontal
    (x, y) = splats.mean.detach().unbind(-1)
    (rx, ry) = splats.extent.unbind(-1)
    here = ((y + ry > top) & (y - ry < bottom) & (x + rx > left) & (x - rx < right)).nonzero()[:, 0]
    across = torch.arange(left, right, device=x.device, dtype=x.dtype) + 0.5
    down = torch.arange(top, bottom, device=x.device, dtype=x.dtype) + 0.5
    dx = (across - splats.mean[here, :1])[:, None, :]
    dy = (down - splats.mean[here, 1:])[:, :, None]
    # alpha_i = o_i exp(-(x - m_i)^T Sigma_i^-1 (x - m_i) / 2), then the products T_i of 1 - alpha.
    xx, xy, yy = (splats.covariance[here] / splats.determinant[here, None]).unbind(-1)
    power = -0.5 * (yy[:, None, None] * dx * dx + xx[:, None, None] * dy * dy) + xy[:, None, None] * dx * dy
    alpha = splats.opacity[here, None, None] * power.exp()
    alpha = torch.where(alpha > MIN_ALPHA, alpha.clamp_max(MAX_ALPHA), torch.zeros_like(alpha))
    passing = torch.cat([alpha.new_ones(1, bottom - top, right - left), (1 - alpha).cumprod(0)])
    image = (
        torch.einsum("nhw,nc->hwc", alpha * passing[:-1], values[here]) + passing[-1][..., None] * background
    )
    return torch.cat([image, passing[-1][..., None]], -1)
