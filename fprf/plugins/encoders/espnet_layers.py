"""Layers of ESPNetv2 by the names of their tensors; groups and kernel sizes are read off the shapes."""

from typing import Annotated

import torch.nn.functional as F
from torch import Tensor

from .frozen import FrozenTensors

__all__ = ["convolve", "norm", "normed_activation", "prelu"]


def convolve(
    tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str, *, stride: int = 1, dilation: int = 1
) -> Annotated[Tensor, "B G h w"]:
    """Zero-padded so that stride 1 keeps the size; with a bias where the file has one."""
    weight = tensors[f"{name}.weight"]
    bias = tensors.get(f"{name}.bias")
    padding = weight.shape[-1] // 2 * dilation
    return F.conv2d(x, weight, bias, stride, padding, dilation, x.shape[1] // weight.shape[1])


def norm(tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str) -> Annotated[Tensor, "B F H W"]:
    """Batch normalisation by the statistics of training."""
    mean, variance, weight, bias = (tensors[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
    return F.batch_norm(x, mean, variance, weight, bias)


def prelu(tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str) -> Annotated[Tensor, "B F H W"]:
    """A slope of its own for the negative part of every channel."""
    return F.prelu(x, tensors[f"{name}.weight"])


def normed_activation(
    tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str, parts: tuple[str, str] = ("bn", "act")
) -> Annotated[Tensor, "B F H W"]:
    """Normalisation, then activation; the decoder numbers them where the base network names them."""
    return prelu(tensors, norm(tensors, x, f"{name}.{parts[0]}"), f"{name}.{parts[1]}")
