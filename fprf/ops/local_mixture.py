"""Which of the regions that meet around a pixel explains what it looks like: mixtures of Gaussians in windows.

Features of encoders are smooth, so the memberships in regions that follow from them are blurred where regions meet. In every
window each region k has a share pi_k and a Gaussian of what its pixels look like (colour, depth), N(m_k, S_k), all weighted by
membership. A pixel's membership is then the posterior

    q_k(p)  ~  (own s_k(p) + (1 - own) pi_k(p)) N(x(p); m_k, S_k + noise^2)

with s the memberships at the beginning; a few such steps are taken, each with the moments of the last (EM). Regions that no
pixel of a window belongs to cannot appear there.

Letters: x guide [H W C], s shares [H W K]; windows are squares of 2 radius pixels, cut at the border. Moments are taken at
cells half a radius apart; the logarithm of N, quadratic in x, is interpolated between them by its coefficients.
"""

import math
from typing import Annotated

import torch
from torch import Tensor

_CELLS = 2.0
"""Cells for each radius."""
_PRESENT = 1e-3
"""Mean share in the image below which a region is left as it is."""
_MASS = 1e-6
"""Pixels of a region in a window below which its moments are those of nothing: 0 with the variance of the noise."""


def explained(
    share: Annotated[Tensor, "H W K"],
    guide: Annotated[Tensor, "H W C"],
    solid: Annotated[Tensor, "H W"],
    *,
    radius: float,
    noise: Annotated[Tensor, "C"],
    own: float = 0.3,
    steps: int = 4,
) -> Annotated[Tensor, "H W K"]:
    """Memberships after `steps`, float32; rows sum to what they did.

    `radius` in pixels, `noise` a deviation > 0 of each channel, `own` in [0, 1]. Pixels that are not `solid` (bool) count for
    nothing and stay.
    """
    if not bool(solid.any()):
        return share
    # What is not solid neither counts nor changes: where a single thing is seen, most of the picture is left out.
    box = tuple(slice(int(at[0]), int(at[-1]) + 1) for at in (solid.any(1).nonzero(), solid.any(0).nonzero()))
    whole, share, guide, solid = share.float().clone(), share[box], guide[box], solid[box]
    present = (share.mean((0, 1)) > _PRESENT).nonzero()[:, 0]
    before, radius = share[..., present].permute(2, 0, 1).float().contiguous(), max(1.0, radius)
    # 1, every channel, and every product of two; about their mean, as squares of what lies far from 0 would round.
    x = torch.where(solid[..., None], guide - guide[solid].mean(0), 0.0).float()
    i, j = torch.triu_indices(x.shape[-1], x.shape[-1])
    monomials = torch.cat([torch.ones_like(x[..., :1]), x, x[..., i] * x[..., j]], -1).permute(2, 0, 1).contiguous()
    masked, after = monomials * solid, before
    for _ in range(steps):
        prior, logarithm = _local_gaussians(after, masked, radius, noise)
        # Bilinear weights of each cell at each pixel, as two small matrices, which take less time than F.interpolate.
        operators = []
        for cells, pixels in zip(prior.shape[1:], solid.shape, strict=True):
            at = ((torch.arange(pixels) + 0.5) * cells / pixels - 0.5).clamp(0, cells - 1)
            operators.append((1 - (at[:, None] - torch.arange(cells)).abs()).clamp_min(0).to(prior))
        rows, columns = operators
        prior = rows @ prior @ columns.T
        likelihood = torch.empty_like(prior)
        for k, coefficients in enumerate(logarithm):  # one region at a time: it stays in the cache
            likelihood[k] = ((rows @ coefficients @ columns.T) * monomials).sum(0)
        # The posterior, of all that these regions had together.
        odds = (own * before + (1 - own) * prior).clamp_min(1e-9).log() + likelihood
        after = torch.where(solid, torch.softmax(odds, 0) * before.sum(0), before)
    whole[box] = share.float().index_copy(2, present, after.permute(1, 2, 0))
    return whole


def _local_gaussians(
    share: Annotated[Tensor, "K H W"], monomials: Annotated[Tensor, "M H W"], radius: float, noise: Annotated[Tensor, "C"]
) -> tuple[Annotated[Tensor, "K h w"], Annotated[Tensor, "K M h w"]]:
    """Share of each region in the windows, and the coefficients of the logarithm of its density, up to a constant."""
    channels = len(noise)
    i, j = torch.triu_indices(channels, channels)
    # Part of each pixel that lies in the window around each cell's centre.
    windows = []
    for pixels in monomials.shape[1:]:
        cells = math.ceil(_CELLS * pixels / radius)
        centre = (torch.arange(cells).double() + 0.5)[:, None] * pixels / cells
        edge = torch.arange(pixels + 1).double()
        overlap = torch.minimum(centre + radius, edge[1:]) - torch.maximum(centre - radius, edge[:-1])
        windows.append(overlap.clamp_min(0).to(share))
    # Moments of each region in each window.
    sums = torch.stack([windows[0] @ (part * monomials) @ windows[1].T for part in share])
    sums = sums.double().permute(0, 2, 3, 1)
    mass = sums[..., :1]
    moments = sums[..., 1:] / mass.clamp_min(_MASS)
    mean, square = moments[..., :channels], moments[..., channels:]
    covariance = square.new_empty(*square.shape[:3], channels, channels)
    covariance[..., i, j] = covariance[..., j, i] = square - mean[..., i] * mean[..., j]
    # Rounding may leave a variance slightly below 0.
    covariance.diagonal(dim1=-2, dim2=-1).clamp_min_(0).add_(noise.double().square())
    # ln N = -(x - m)^T S^-1 (x - m) / 2 - ln |S| / 2, as coefficients of the monomials.
    root = torch.linalg.cholesky(covariance)
    inverse = torch.cholesky_inverse(root)
    slope = (inverse @ mean[..., None])[..., 0]
    constant = -0.5 * (slope * mean).sum(-1) - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    curvature = inverse[..., i, j] * torch.where(i == j, -0.5, -1.0).double()
    logarithm = torch.cat([constant[..., None], slope, curvature], -1).permute(0, 3, 1, 2)
    prior = (mass / mass.sum(0).clamp_min(_MASS))[..., 0]
    return prior.float(), logarithm.float()
