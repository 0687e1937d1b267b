"""Is it still the same picture? How much of the local structure of the luminance a restyled picture keeps.

    structure = mean over windows of (2 σ_ab + K) / (σ_a² + σ_b² + K)                     Wang et al. 2004, without luminance

A style may make a picture darker and duller as a whole, so both luminances are first brought to one mean and deviation. What
is left to punish is what a style must not do: noise in the sky, blotches, halos, lost edges. `ssim` of the plain luminances
is given beside it; that also counts the change of light which was asked for.
"""

from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError
from ..style.controls import luma
from .metrics import ssim

__all__ = ["luminance_ssim", "structure"]

_SIGMA = 1.5
_REACH = 5
"""Pixels from the middle of a window to its side: Wang's 11 x 11."""
_DEVIATION = 0.25
"""Both luminances get this deviation: about that of a photograph, for which K was chosen."""
_K = 0.03**2
_FLAT = 1e-3
"""Pictures that vary less (a quarter of an 8-bit step) have no structure to bring to a common deviation."""


def structure(a: Annotated[Tensor, "H W 3"], b: Annotated[Tensor, "H W 3"]) -> float:
    """In [-1, 1], 1 for pictures that differ by brightness and contrast alone; symmetric.

    Raises DataError for pictures of different sizes, or smaller than a window of 11 pixels.
    """
    if a.shape != b.shape or a.ndim != 3 or min(a.shape[:2]) <= 2 * _REACH:
        raise DataError(
            f"structure: pictures of shape {tuple(a.shape)} and {tuple(b.shape)}; both must be [H W 3] of one size, with "
            f"sides of at least {2 * _REACH + 1} pixels"
        )
    x, y = _standard(a), _standard(b)
    means = [_windows(each) for each in (x, y, x * x, y * y, x * y)]
    var_x, var_y = means[2] - means[0] ** 2, means[3] - means[1] ** 2
    shared = means[4] - means[0] * means[1]
    return float(((2 * shared + _K) / (var_x + var_y + _K)).mean().clamp(-1, 1))


def luminance_ssim(a: Annotated[Tensor, "H W 3"], b: Annotated[Tensor, "H W 3"]) -> float:
    """SSIM of the luminances, in [-1, 1]. Raises as `metrics.ssim`."""
    grey = [luma(image.reshape(-1, 3)).reshape(*image.shape[:2], 1).expand(-1, -1, 3) for image in (a, b)]
    return ssim(*grey)


def _standard(image: Tensor) -> Annotated[Tensor, "1 1 H W"]:
    grey = luma(image.reshape(-1, 3).double()).reshape(1, 1, *image.shape[:2])
    centred = grey - grey.mean()
    spread = centred.square().mean().sqrt()
    return centred * (_DEVIATION / spread) if float(spread) > _FLAT else centred


def _windows(x: Annotated[Tensor, "1 1 H W"]) -> Tensor:
    """Gaussian means over the windows that lie wholly inside."""
    at = torch.arange(-_REACH, _REACH + 1, dtype=x.dtype, device=x.device)
    kernel = torch.exp(-at.square() / (2 * _SIGMA**2))
    kernel = kernel / kernel.sum()
    return F.conv2d(F.conv2d(x, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))
