"""The optimal-transport (Monge) map between Gaussians, float64.

T = Cs^1/2 (Cs^1/2 Cc Cs^1/2)^-1/2 Cs^1/2 is the one symmetric positive map with T Cc T = Cs: of all linear maps that
give the style's covariance it moves the features least. Computed by one singular value decomposition,
Cs^1/2 Cc^1/2 = U S V^T, so that T = Cs^1/2 U S^-1 U^T Cs^1/2: S has the square root of the condition of the product under
the inverse root above, which would lose half of the digits. c content, s style.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..ops.precision import full_precision
from .statistics import double

__all__ = ["limit_gain", "monge", "symmetric_root"]

_RIDGE = 1e-4
"""Variance added in every direction, as a share of the mean variance: 1 % of the deviation, as AdaIN's floor."""


def symmetric_root(c: Annotated[Tensor, "... C C"]) -> Annotated[Tensor, "... C C"]:
    """The symmetric positive root of symmetric matrices; negative eigenvalues (rounding) count as 0."""
    with full_precision(c):
        value, vector = torch.linalg.eigh(c)
        root: Tensor = (vector * value.clamp_min(0.0).sqrt()[..., None, :]) @ vector.mT
        return root


def monge(
    content: Annotated[Tensor, "... C C"], style: Annotated[Tensor, "... C C"], *, gain: float
) -> Annotated[Tensor, "... C C"]:
    """Symmetric T [C C], float64, with T content T = style, for covariances of any rank, 0 among them.

    Both sides get the same relative ridge, so equal covariances give the identity; eigenvalues of T above `gain` (>= 1)
    are capped, which is where it stops matching the style exactly.
    """
    style_root = symmetric_root(_with_ridge(double(style)))
    left, value, _ = torch.linalg.svd(style_root @ symmetric_root(_with_ridge(double(content))))
    half = style_root @ (left / value.clamp_min(torch.finfo(value.dtype).tiny).sqrt()[..., None, :])
    product = half @ half.mT
    return limit_gain((product + product.mT) / 2, gain)


def limit_gain(t: Annotated[Tensor, "... C C"], gain: float) -> Annotated[Tensor, "... C C"]:
    """The symmetric positive map with no direction amplified more than `gain`; untouched, bit for bit, if none is."""
    with full_precision(t):
        value, vector = torch.linalg.eigh(t)
        capped = (vector * value.clamp(0.0, gain)[..., None, :]) @ vector.mT
    capped = (capped + capped.mT) / 2
    return torch.where((value[..., -1] > gain)[..., None, None], capped, t)


def _with_ridge(c: Tensor) -> Tensor:
    c = (c + c.mT) / 2
    variance = c.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(torch.finfo(c.dtype).tiny ** 0.5)
    return c + _RIDGE * variance[..., None, None] * torch.eye(c.shape[-1], dtype=c.dtype, device=c.device)
