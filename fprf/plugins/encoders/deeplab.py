"""DeepLabv3 (Chen et al.) on MobileNetV2, trained on PASCAL VOC: any layer of its backbone, or the scores of its classes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .frozen import FrozenTensors
from .mobilenet import DEEPLAB, TENSORFLOW_EPS, MobileNetV2, fold, stride_at
from .network import NetworkEncoder, fitting
from .weight_sources import WeightSource, find_weights, read_tensors, stated_triple

__all__ = ["SOURCE", "build_deeplab"]

FLAG = "--semantic.encoder.weights"
SOURCE = WeightSource(
    "DeepLabv3",
    "deeplabv3_mobilenetv2_pascal.safetensors",
    "backbone.N.* named as torchvision's mobilenet_v2 features.N, head.*; docs/encoders.md",
    FLAG,
)
LAST = 17
MEAN = STD = (0.5, 0.5, 0.5)


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
    path = find_weights(SOURCE, weights)
    tensors, metadata = read_tensors(path, SOURCE)
    mean, std = (stated_triple(metadata, key, default, path) for key, default in (("mean", MEAN), ("std", STD)))
    last = LAST if layer == "logits" else int(layer.rpartition(".")[2])
    with fitting(str(path), f"DeepLabv3 {layer}", FLAG):
        folded = fold(tensors, "backbone.", TENSORFLOW_EPS)
        backbone = MobileNetV2(folded, layout=DEEPLAB, last=last, same=True, mean=mean, std=std)
        head = {name.removeprefix("head."): value for name, value in tensors.items() if name.startswith("head.")}
        network = _Scores(backbone, head) if layer == "logits" else backbone
        return NetworkEncoder(f"deeplab:{layer}", network, stride=stride_at(DEEPLAB, last))
