"""MobileNetV2 (Sandler et al.) up to any of its 19 `features`, as TensorFlow or torchvision trained it.

Where a feature looks depends on the parity that a network was trained with: on even sizes its filters have learned to
make up for the half pixel that a stride-2 convolution is off; on odd ones (DeepLab's 513) cells are centred on every
s-th pixel, so the image is shifted by half a cell and the first and last cells are dropped. Measured by mirroring.

DeepLabv3 (Chen et al.) on MobileNetV2, trained on PASCAL VOC: any layer of its backbone, or the scores of its classes.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...errors import WeightsError
from ..weights import WeightSource, find_weights, input_statistics, read_tensors, torchvision_file
from .frozen import FrozenTensors, NetworkEncoder, fitting

TENSORFLOW_EPS, TORCHVISION_EPS = 1e-3, 1e-5
FLAG = "--semantic.encoder.weights"
SOURCE = torchvision_file("MobileNetV2", "mobilenet_v2-b0353104.pth", FLAG)


class Layout(NamedTuple):
    """Differences between the classifier and DeepLab's backbone."""

    strides: tuple[int, ...]
    """Of blocks 1 to 17."""
    dilated: int
    """First block whose depthwise convolution has holes."""
    odd: bool
    """Trained on odd sizes."""


CLASSIFIER = Layout((1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1), dilated=18, odd=False)
DEEPLAB = Layout((1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1), dilated=15, odd=True)
HEAD = 18
"""The 1x1 convolution after the last block."""


class MobileNetV2(nn.Module):
    """Inverted residual blocks 0..`last` on folded weights `N.conv...{weight,bias}`.

    `same` pads as TensorFlow does, else both sides alike. Takes multiples of the stride of `last`.
    """

    def __init__(
        self,
        folded: Mapping[str, Tensor],
        *,
        layout: Layout,
        last: int,
        same: bool,
        mean: Annotated[Tensor, "3"],
        std: Annotated[Tensor, "3"],
    ) -> None:
        super().__init__()
        self._layout, self._last, self._same = layout, last, same
        self.tensors = FrozenTensors({name: value for name, value in folded.items() if int(name.partition(".")[0]) <= last})
        self.register_buffer("mean", mean.view(3, 1, 1))
        self.register_buffer("std", std.view(3, 1, 1))

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F h w"]:
        """Features of sRGB images in [0, 1]: linear after a block, in [0, 6] after the first and the last convolution."""
        x = (image - self.get_buffer("mean")) / self.get_buffer("std")
        if self._layout.odd:
            stride = stride_at(self._layout, self._last)
            before, after = stride // 2, stride // 2 + 1
            x = F.pad(x, (before, after, before, after), mode="replicate")
        x = self._convolve(x, "0.0", stride=2).clamp(0, 6)
        for block in range(1, min(self._last, len(self._layout.strides)) + 1):
            x = self._block(x, block)
        if self._last == HEAD:
            x = self._convolve(x, f"{HEAD}.0").clamp(0, 6)
        return x[:, :, 1:-1, 1:-1] if self._layout.odd else x

    def _block(self, x: Tensor, block: int) -> Tensor:
        stride, dilation = self._layout.strides[block - 1], 2 if block >= self._layout.dilated else 1
        y, at = x, 0
        if block > 1:
            y, at = self._convolve(y, f"{block}.conv.0.0").clamp(0, 6), 1
        y = self._convolve(y, f"{block}.conv.{at}.0", stride=stride, dilation=dilation, groups=y.shape[1]).clamp(0, 6)
        y = self._convolve(y, f"{block}.conv.{at + 1}")
        return x + y if stride == 1 and x.shape == y.shape else y

    def _convolve(self, x: Tensor, name: str, stride: int = 1, dilation: int = 1, groups: int = 1) -> Tensor:
        weight, bias = self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"]
        reach = (weight.shape[-1] - 1) * dilation
        x = _same(x, reach, stride) if self._same else F.pad(x, (reach // 2,) * 4)
        return F.conv2d(x, weight, bias, stride, 0, dilation, groups)


def build_mobilenet(layer: str, *, weights: Path | None) -> NetworkEncoder:
    """`features.N` of a file whose metadata says how it was trained; without any, it is torchvision's.

    Raises WeightsError where the file is absent, or ends before the layer.
    """
    path = find_weights(SOURCE, weights)
    tensors, metadata = read_tensors(path, SOURCE)
    same = metadata.get("padding", "").startswith("TensorFlow SAME")
    mean, std = input_statistics(metadata, path)
    last = int(layer.rpartition(".")[2])
    with fitting(str(path), f"MobileNetV2 {layer}", FLAG):
        folded = fold(tensors, "features.", _eps(metadata, path))
        network = MobileNetV2(folded, layout=CLASSIFIER, last=last, same=same, mean=mean, std=std)
        padding = "same" if same else "symmetric"
        return NetworkEncoder(f"mobilenet-v2:{layer}:{padding}", network, stride=stride_at(CLASSIFIER, last))


def stride_at(layout: Layout, last: int) -> int:
    """Pixels per feature after block `last`."""
    return 2 * math.prod(layout.strides[:last])


def fold(tensors: Mapping[str, Tensor], prefix: str, eps: float) -> dict[str, Tensor]:
    """Batch normalisation, one place after its convolution, into it; convolutions with a bias of their own stay."""
    folded = {}
    for key, weight in tensors.items():
        name = key.removeprefix(prefix).removesuffix(".weight")
        place, _, number = name.rpartition(".")
        if key != f"{prefix}{name}.weight" or weight.ndim != 4 or not (number + place[:1]).isdecimal():
            continue
        norm = f"{prefix}{place}.{int(number) + 1}"
        if f"{norm}.running_var" in tensors:
            gain = tensors[f"{norm}.weight"] / (tensors[f"{norm}.running_var"] + eps).sqrt()
            folded[f"{name}.weight"] = weight * gain.view(-1, 1, 1, 1)
            folded[f"{name}.bias"] = tensors[f"{norm}.bias"] - tensors[f"{norm}.running_mean"] * gain
        else:
            folded[f"{name}.weight"], folded[f"{name}.bias"] = weight, tensors[f"{prefix}{name}.bias"]
    return folded


def _same(x: Tensor, reach: int, stride: int) -> Tensor:
    """TensorFlow's padding: as little as gives every stride-th pixel an output, the odd one after."""
    pads = []
    for n in (x.shape[3], x.shape[2]):
        total = max((-(-n // stride) - 1) * stride + reach + 1 - n, 0)
        pads += [total // 2, total - total // 2]
    return F.pad(x, pads)


def _eps(metadata: Mapping[str, str], path: Path) -> float:
    text = metadata.get("bn_eps", str(TORCHVISION_EPS))
    try:
        return float(text)
    except ValueError as error:
        raise WeightsError(f"{path}: metadata 'bn_eps' is {text!r}, not a number such as 0.001") from error


DEEPLAB_SOURCE = WeightSource(
    "DeepLabv3",
    "deeplabv3_mobilenetv2_pascal.safetensors",
    "backbone.N.* named as torchvision's mobilenet_v2 features.N, head.*; docs/encoders.md",
    FLAG,
)
_DEEPLAB_LAST = 17


class _Scores(nn.Module):
    """Backbone and head without dilated branches: the mean over the image beside every cell, then the classes' scores."""

    def __init__(self, backbone: MobileNetV2, head: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.backbone, self.head = backbone, FrozenTensors(head)

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B K h w"]:
        """One score a class, before the softmax."""
        x = self.backbone(image)
        whole = F.relu(self._convolve(x.mean(dim=(2, 3), keepdim=True), "image_pooling")).expand(-1, -1, *x.shape[2:])
        near = F.relu(self._convolve(x, "aspp0"))
        joined = F.relu(self._convolve(torch.cat([whole, near], dim=1), "concat_projection"))
        return self._convolve(joined, "logits")

    def _convolve(self, x: Tensor, name: str) -> Tensor:
        return F.conv2d(x, self.head[f"{name}.weight"], self.head[f"{name}.bias"])


def build_deeplab(layer: str, *, weights: Path | None) -> NetworkEncoder:
    """`backbone.N` or `logits`. Raises WeightsError where the file is absent or does not hold the layer."""
    path = find_weights(DEEPLAB_SOURCE, weights)
    tensors, metadata = read_tensors(path, DEEPLAB_SOURCE)
    mean, std = input_statistics(metadata, path, (0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
    last = _DEEPLAB_LAST if layer == "logits" else int(layer.rpartition(".")[2])
    with fitting(str(path), f"DeepLabv3 {layer}", FLAG):
        folded = fold(tensors, "backbone.", TENSORFLOW_EPS)
        backbone = MobileNetV2(folded, layout=DEEPLAB, last=last, same=True, mean=mean, std=std)
        head = {name.removeprefix("head."): value for name, value in tensors.items() if name.startswith("head.")}
        network = _Scores(backbone, head) if layer == "logits" else backbone
        return NetworkEncoder(f"deeplab:{layer}", network, stride=stride_at(DEEPLAB, last))
