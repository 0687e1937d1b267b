"""LPIPS 0.1 with AlexNet (Zhang et al. 2018, arXiv:1801.03924), with the weights of its authors.

    LPIPS(a, b) = Σ_layers mean over pixels of Σ_channels w_c (f_c(a) / |f(a)| - f_c(b) / |f(b)|)²

f: activations of the five convolutions, w ≥ 0: the learned heads. 0 for equal images, about 0.7 for unrelated ones.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError, NumericsError
from ..plugins.weights import read_weights

WEIGHTS = Path(__file__).parent / "weights" / "lpips-alex.safetensors"
_STRIDES, _PADS = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
_POOLED = (2, 3)
"""Convolutions after a pooling."""
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Of colours in [-1, 1]: ImageNet's mean and deviation."""
_EPS = 1e-10
"""Added to lengths, as the authors do: a feature may be 0."""
_SMALLEST = 31
"""Pixels of a side that the second pooling leaves one of."""


@torch.no_grad()
def lpips(a: Annotated[Tensor, "H W 3"], b: Annotated[Tensor, "H W 3"], where: Annotated[Tensor, "H W"] | None = None) -> float:
    """LPIPS of sRGB images in [0, 1], at least 0, symmetric; `where`: mean over the cells that lie there, by their share.

    Images with a side below 31 pixels are enlarged. Raises DataError for unlike shapes, NumericsError for NaN and infinities.
    """
    if a.shape != b.shape or a.ndim != 3 or a.shape[-1] != 3 or a.numel() == 0:
        raise DataError(f"lpips: images of shape {tuple(a.shape)} and {tuple(b.shape)}; both must be [H W 3] of one size")
    # Both images as one batch; small ones are enlarged, since the second pooling would leave nothing of them.
    weights = {name: value.to(a.device) for name, value in _weights().items()}
    pair = torch.stack([a, b.to(a.device)]).float().permute(0, 3, 1, 2)
    if min(pair.shape[2:]) < _SMALLEST:
        scale = _SMALLEST / min(pair.shape[2:])
        size = [max(_SMALLEST, round(scale * n)) for n in pair.shape[2:]]
        pair = F.interpolate(pair, size, mode="bilinear", align_corners=False)
    total = 0.0
    for layer, features in enumerate(_activations(weights, pair), start=1):
        # Features of unit length, compared channel by channel by the weights of the layer's head.
        first, second = features / (features.square().sum(1, keepdim=True).sqrt() + _EPS)
        apart = torch.einsum("chw,c->hw", (first - second).square(), weights[f"head{layer}"]).double()
        # A cell counts by the share of it that lies in the mask.
        share = torch.ones_like(apart)
        if where is not None:
            share = F.interpolate(where[None, None].to(apart), apart.shape, mode="area")[0, 0]
        total += float((apart * share).sum() / share.sum())
    if total != total:
        raise NumericsError("lpips is nan: an image holds values that are not finite, or nothing of it counts")
    return total


def _activations(weights: Mapping[str, Tensor], images: Annotated[Tensor, "B 3 H W"]) -> Iterator[Annotated[Tensor, "B C h w"]]:
    """Of AlexNet's convolutions, one after the other."""
    shift, scale = (images.new_tensor(each).view(1, 3, 1, 1) for each in (_SHIFT, _SCALE))
    x = (2 * images - 1 - shift) / scale
    for layer, (stride, padding) in enumerate(zip(_STRIDES, _PADS, strict=True), start=1):
        if layer in _POOLED:
            x = F.max_pool2d(x, 3, 2)
        x = F.relu(F.conv2d(x, weights[f"conv{layer}.weight"], weights[f"conv{layer}.bias"], stride, padding))
        yield x


@cache
def _weights() -> Mapping[str, Tensor]:
    return read_weights(WEIGHTS)[0]
