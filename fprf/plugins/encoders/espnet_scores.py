"""ESPNetv2's decoder: pyramid pools from level 4 up to level 1, to one score a class at stride 2."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from .espnet_layers import convolve, normed_activation
from .frozen import FrozenTensors

__all__ = ["class_scores"]

SCALES = (2.0, 1.5, 1.0, 0.5, 0.1)
SMALLEST = 5
"""Cells along an axis that a pyramid's coarse copies keep at least."""


def class_scores(tensors: FrozenTensors, levels: Sequence[Tensor]) -> Tensor:
    """From the maps [B F h w] of the four levels, finest first, to [B K h w] at the size of the first."""
    x = _pyramid_pool(tensors, levels[-1], "bu_dec_l1")
    x = normed_activation(tensors, x, "bu_dec_l1.br.br", ("0", "1"))
    for step, level in zip((2, 3, 4), reversed(levels[:-1]), strict=True):
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True) + _merged(tensors, level, step)
        x = _pyramid_pool(tensors, normed_activation(tensors, x, f"bu_br_l{step}", ("0", "1")), f"bu_dec_l{step}")
        if step < len(levels):
            x = normed_activation(tensors, x, f"bu_dec_l{step}.br.br", ("0", "1"))
    return x


def _merged(tensors: FrozenTensors, level: Tensor, step: int) -> Tensor:
    """A level of the base network, its channels weighed by what the whole image holds."""
    name = f"merge_enc_dec_l{step}"
    shares = torch.sigmoid(convolve(tensors, level.mean(dim=(2, 3), keepdim=True), f"{name}.wt_layer.1"))
    return shares * _convolved(tensors, level, f"{name}.expansion_layer.cbr")


def _pyramid_pool(tensors: FrozenTensors, x: Tensor, name: str) -> Tensor:
    """One depthwise convolution at each of several sizes, merged channel by channel."""
    x = _convolved(tensors, x, f"{name}.projection_layer.cbr")
    size = (x.shape[2], x.shape[3])
    found = []
    for index, scale in enumerate(SCALES):
        scaled = (max(SMALLEST, math.ceil(size[0] * scale)), max(SMALLEST, math.ceil(size[1] * scale)))
        stage = f"{name}.stages.{index}"
        if scale > 1:
            larger = F.interpolate(x, scaled, mode="bilinear", align_corners=True)
            found.append(F.adaptive_avg_pool2d(convolve(tensors, larger, stage), size))
        elif scale < 1:
            smaller = convolve(tensors, F.adaptive_avg_pool2d(x, scaled), stage)
            found.append(F.interpolate(smaller, size, mode="bilinear", align_corners=True))
        else:
            found.append(convolve(tensors, x, stage))
    joined = normed_activation(tensors, torch.cat(found, dim=1), f"{name}.merge_layer.0.br", ("0", "1"))
    # Channel by channel, all sizes of it together: what the grouped convolution after it takes.
    batch, channels = joined.shape[:2]
    joined = joined.view(batch, len(SCALES), channels // len(SCALES), *size).transpose(1, 2).flatten(1, 2)
    return convolve(tensors, _convolved(tensors, joined, f"{name}.merge_layer.2.cbr"), f"{name}.merge_layer.3")


def _convolved(tensors: FrozenTensors, x: Tensor, name: str) -> Tensor:
    return normed_activation(tensors, convolve(tensors, x, f"{name}.0"), name, ("1", "2"))
