"""The rasteriser of 3D Gaussians in plain torch: any device, any float type, gradients by autograd.

Letters: N Gaussians, K harmonics of a colour channel (1, 4, 9 or 16), C feature channels, H W pixels.

    Sigma = J W (R S)(R S)^T W^T J^T + 0.3 I      alpha_i(x) = o_i exp(-(x - m_i)^T Sigma_i^-1 (x - m_i) / 2), at most 0.99
    image = sum_i alpha_i T_i v_i + T_N background      T_i = prod_j<i (1 - alpha_j), front to back by the depth of the means

alpha below 1/255 counts as 0. With `antialiased` o_i is multiplied by sqrt(det(Sigma - 0.3 I) / det Sigma): what the blur
widens it makes fainter (Mip-Splatting). J is the projection's derivative at the mean, its tangents limited to 15 % beyond the
image's edges, as in the published code.
"""

from collections.abc import Iterator
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

BLUR, MIN_ALPHA, MAX_ALPHA = 0.3, 1 / 255, 0.99
TILE = 16
_MOST_LOG, _HUGE, _LARGE = 30.0, 1e16, 1e15
_SH = (
    0.28209479177387814, 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396, 0.5900435899266435,
    2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277,
)  # fmt: skip


class Pinhole(NamedTuple):
    """A camera without distortion; a constant: nothing has a gradient in it."""

    intrinsics: Annotated[Tensor, "3 3"]
    """fx, fy, cx, cy in pixels, pixel centres at +0.5; no skew."""
    world_to_camera: Annotated[Tensor, "4 4"]
    """Camera axes are OpenCV's: x right, y down, z forward."""
    width: int
    height: int
    near: float = 0.01
    """World distance along z up to which nothing is drawn."""


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


def evaluate_harmonics(harmonics: Annotated[Tensor, "N K C"], direction: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N C"]:
    """Real spherical harmonics at unit directions, in the order and with the signs of 3D Gaussian splatting files.

    C channels, K = (degree + 1)^2 of at most degree 3. A colour is this + 0.5, cut at 0.
    """
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [
        torch.full_like(x, _SH[0]), -_SH[1] * y, _SH[1] * z, -_SH[1] * x,
        _SH[2] * x * y, -_SH[2] * y * z, _SH[3] * (2 * zz - xx - yy), -_SH[2] * x * z, _SH[4] * (xx - yy),
        -_SH[5] * y * (3 * xx - yy), _SH[6] * x * y * z, -_SH[7] * y * (4 * zz - xx - yy),
        _SH[8] * z * (2 * zz - 3 * xx - 3 * yy), -_SH[7] * x * (4 * zz - xx - yy), _SH[9] * z * (xx - yy),
        -_SH[5] * x * (xx - 3 * yy),
    ]  # fmt: skip
    return (torch.stack(basis[: harmonics.shape[1]], -1)[..., None] * harmonics).sum(1)


def view_colours(
    means: Annotated[Tensor, "N 3"], harmonics: Annotated[Tensor, "N K 3"], camera: Pinhole
) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N"]]:
    """Colours from 0 on as a camera sees them, and which of them are finite; the others are of harmonics 0."""
    pose = camera.world_to_camera.to(means)
    fine = (means.abs() < _LARGE).all(-1) & (harmonics.abs() < _LARGE).flatten(1).all(-1)
    direction = torch.where(fine[:, None], means, torch.zeros_like(means)) + pose[:3, :3].T @ pose[:3, 3]
    harmonics = torch.where(fine[:, None, None], harmonics, torch.zeros_like(harmonics))
    return (evaluate_harmonics(harmonics, torch.nn.functional.normalize(direction, dim=-1)) + 0.5).clamp_min(0), fine


def _rotations(quaternions: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1, eps=1e-12).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).view(-1, 3, 3)


def project_reference(
    means: Annotated[Tensor, "N 3"],
    quaternions: Annotated[Tensor, "N 4"],
    log_scales: Annotated[Tensor, "N 3"],
    logits: Annotated[Tensor, "N"],
    camera: Pinhole,
    *,
    antialiased: bool,
) -> Projected:
    """Gaussians on the image plane; those with NaN, means beyond 1e15 or more than 1e8 pixels wide are not drawn."""
    world = camera.world_to_camera.to(means)
    fx, fy, cx, cy = (float(camera.intrinsics[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    shape = torch.cat([quaternions, log_scales, logits[:, None]], -1)
    fine = (means.abs() < _LARGE).all(-1) & (quaternions.abs() < _LARGE).all(-1) & ~shape.isnan().any(-1)
    means, quaternions = (torch.where(fine[:, None], x, torch.ones_like(x)) for x in (means, quaternions))
    log_scales = torch.where(fine[:, None], log_scales, torch.zeros_like(log_scales)).clamp(-_MOST_LOG, _MOST_LOG)
    logits = torch.where(fine, logits, torch.zeros_like(logits)).clamp(-_MOST_LOG, _MOST_LOG)
    x, y, depth = (means @ world[:3, :3].T + world[:3, 3]).unbind(-1)
    z = torch.where(depth > camera.near, depth, torch.ones_like(depth))
    u, v = x / z, y / z
    beyond_u, beyond_v = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    near_u = u.clamp(-cx / fx - beyond_u, (camera.width - cx) / fx + beyond_u)
    near_v = v.clamp(-cy / fy - beyond_v, (camera.height - cy) / fy + beyond_v)
    axes = world[:3, :3] @ _rotations(quaternions) * log_scales.exp()[:, None]
    across = (fx / z)[:, None] * (axes[:, 0] - near_u[:, None] * axes[:, 2])
    down = (fy / z)[:, None] * (axes[:, 1] - near_v[:, None] * axes[:, 2])
    fine = fine & (across.square().sum(-1) + down.square().sum(-1) < _HUGE)
    across, down = (torch.where(fine[:, None], x, torch.ones_like(x)) for x in (across, down))
    xx, yy, xy = across.square().sum(-1), down.square().sum(-1), (across * down).sum(-1)
    sharp = torch.linalg.cross(across, down).square().sum(-1)
    whole = sharp + BLUR * (xx + yy) + BLUR**2
    opacity = torch.sigmoid(logits)
    if antialiased:
        opacity = opacity * (sharp / whole + 1e-8).sqrt()
    covariance = torch.stack([xx + BLUR, xy, yy + BLUR], -1)
    mean = torch.stack([fx * u + cx, fy * v + cy], -1)
    reach = 2 * (opacity.detach() / MIN_ALPHA).clamp_min(1e-30).log()
    extent = (reach.clamp_min(0)[:, None] * covariance.detach()[:, ::2]).sqrt()
    seen = fine & (depth > camera.near) & (reach > 0)
    return Projected(mean, covariance, whole, depth, opacity, torch.where(seen[:, None], extent, -torch.ones_like(extent)))


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
    shown = splats.extent[:, 0] > 0
    order = splats.depth.detach().masked_fill(~shown, torch.inf).argsort(stable=True)[: int(shown.sum())]
    splats, values = Projected(*(x[order] for x in splats)), values[order]
    behind = torch.cat([background, background.new_zeros(1)])
    rows = []
    for top in range(0, camera.height, TILE):
        row = list(_tiles(splats, values, behind, top, min(top + TILE, camera.height), camera.width))
        rows.append(torch.cat(row, 1))
    image = torch.cat(rows)
    return image[..., :-1], image[..., -1]


def _tiles(splats: Projected, values: Tensor, background: Tensor, top: int, bottom: int, width: int) -> Iterator[Tensor]:
    """Values, depth and transmittance [h w C+2] of one row of tiles."""
    (x, y), (rx, ry) = splats.mean.detach().unbind(-1), splats.extent.unbind(-1)
    in_row = (y + ry > top) & (y - ry < bottom)
    for left in range(0, width, TILE):
        right = min(left + TILE, width)
        here = (in_row & (x + rx > left) & (x - rx < right)).nonzero()[:, 0]
        across = torch.arange(left, right, device=x.device, dtype=x.dtype) + 0.5
        down = torch.arange(top, bottom, device=x.device, dtype=x.dtype) + 0.5
        dx = (across - splats.mean[here, :1])[:, None, :]
        dy = (down - splats.mean[here, 1:])[:, :, None]
        xx, xy, yy = (splats.covariance[here] / splats.determinant[here, None]).unbind(-1)
        power = -0.5 * (yy[:, None, None] * dx * dx + xx[:, None, None] * dy * dy) + xy[:, None, None] * dx * dy
        alpha = splats.opacity[here, None, None] * power.exp()
        alpha = torch.where(alpha > MIN_ALPHA, alpha.clamp_max(MAX_ALPHA), torch.zeros_like(alpha))
        passing = torch.cat([alpha.new_ones(1, bottom - top, right - left), (1 - alpha).cumprod(0)])
        image = torch.einsum("nhw,nc->hwc", alpha * passing[:-1], values[here]) + passing[-1][..., None] * background
        yield torch.cat([image, passing[-1][..., None]], -1)
