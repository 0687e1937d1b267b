"""MobileNetV2 and DeepLab's MobileNetV2 backbone as teachers: inference only, TensorFlow's padding (SAME).

Where a feature looks depends on the parity that a network was trained with: on even sizes its filters have learned to
make up for the half pixel that a stride-2 convolution is off; on odd ones (DeepLab's 513) cells are centred on every
16th pixel, so the image is shifted by half a cell and the first row and column are dropped. Measured by mirroring.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import WeightsError
from ..plugins.weightfiles import read_weights

__all__ = ["MobileNetTeacher", "load_teacher"]

STRIDES = (1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1)
DEEPLAB_STRIDES = (1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1)
NORM_EPS = 1e-3
CELL = 16
"""Pixels per feature."""


class MobileNetTeacher:
    """Inverted residual blocks 0..`last` on folded weights `N.conv...{weight,bias}`; stride 16."""

    def __init__(
        self, name: str, folded: Mapping[str, Tensor], *, strides: tuple[int, ...], dilated: int, last: int, odd: bool
    ) -> None:
        self.name, self._folded = name, folded
        self._strides, self._dilated, self._last, self._odd = strides, dilated, last, odd

    @torch.no_grad()
    def __call__(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F h w"]:
        """Features of sRGB images in [0, 1], one per 16 pixels, rounded up."""
        right, below = -image.shape[-1] % CELL, -image.shape[-2] % CELL
        before, after = (CELL // 2, CELL // 2 + 1) if self._odd else (0, 0)
        x = F.pad(2 * image - 1, (before, right + after, before, below + after), mode="replicate")
        x = self._convolve(x, "0.0", stride=2).clamp(0, 6)
        for block in range(1, self._last + 1):
            x = self._block(x, block)
        return x[:, :, 1:-1, 1:-1] if self._odd else x

    def _block(self, x: Tensor, block: int) -> Tensor:
        stride, dilation = self._strides[block - 1], 2 if block >= self._dilated else 1
        y, at = x, 0
        if block > 1:
            y, at = self._convolve(y, f"{block}.conv.0.0").clamp(0, 6), 1
        y = self._convolve(y, f"{block}.conv.{at}.0", stride=stride, dilation=dilation, groups=y.shape[1]).clamp(0, 6)
        y = self._convolve(y, f"{block}.conv.{at + 1}")
        return x + y if stride == 1 and x.shape == y.shape else y

    def _convolve(self, x: Tensor, name: str, stride: int = 1, dilation: int = 1, groups: int = 1) -> Tensor:
        weight, bias = self._folded[f"{name}.weight"], self._folded[f"{name}.bias"]
        return F.conv2d(_same(x, weight.shape[-1], stride, dilation), weight, bias, stride, 0, dilation, groups)


def load_teacher(path: Path) -> MobileNetTeacher:
    """MobileNetV2 (`features.N`, up to block 13) or DeepLab's backbone (`backbone.N`, folded, up to block 17)."""
    tensors, _ = read_weights(path)
    if "backbone.17.conv.2.weight" in tensors:
        folded = {name.removeprefix("backbone."): value for name, value in tensors.items()}
        name = "deeplab-mobilenetv2:backbone.17"
        return MobileNetTeacher(name, folded, strides=DEEPLAB_STRIDES, dilated=15, last=17, odd=True)
    if "features.13.conv.3.running_var" in tensors:
        name = "mobilenetv2:features.13"
        return MobileNetTeacher(name, _folded(tensors), strides=STRIDES, dilated=99, last=13, odd=False)
    raise WeightsError(f"{path}: neither MobileNetV2 (features.N) nor DeepLab's MobileNetV2 backbone (backbone.N)")


def _folded(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Batch normalisation into the convolution before it: torchvision puts the norm one place after."""
    folded = {}
    for name, weight in tensors.items():
        if not name.endswith(".weight") or weight.ndim != 4:
            continue
        place, _, number = name.removesuffix(".weight").rpartition(".")
        norm = f"{place}.{int(number) + 1}"
        gain = tensors[f"{norm}.weight"] / (tensors[f"{norm}.running_var"] + NORM_EPS).sqrt()
        key = f"{place}.{number}".removeprefix("features.")
        folded[f"{key}.weight"] = weight * gain.view(-1, 1, 1, 1)
        folded[f"{key}.bias"] = tensors[f"{norm}.bias"] - tensors[f"{norm}.running_mean"] * gain
    return folded


def _same(x: Tensor, size: int, stride: int, dilation: int) -> Tensor:
    pads = []
    for n in (x.shape[3], x.shape[2]):
        total = max((-(-n // stride) - 1) * stride + (size - 1) * dilation + 1 - n, 0)
        pads += [total // 2, total - total // 2]
    return F.pad(x, pads)
