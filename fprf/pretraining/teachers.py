"""MobileNetV2 and DeepLab's MobileNetV2 backbone as teachers: features of images of any size, one per 16 pixels."""

from itertools import chain
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..errors import WeightsError
from ..plugins.encoders.frozen import replicate_to_multiple
from ..plugins.encoders.mobilenet import CLASSIFIER, DEEPLAB, TENSORFLOW_EPS, MobileNetV2, fold
from ..plugins.weightfiles import read_weights

__all__ = ["MobileNetTeacher", "load_teacher"]

CELL = 16
"""Pixels per feature."""
GREY = torch.full((3,), 0.5)


class MobileNetTeacher:
    """A network that is not resized to: borders are repeated until cells cover the image."""

    def __init__(self, name: str, network: MobileNetV2) -> None:
        self.name, self._network = name, network

    def to(self, device: torch.device) -> "MobileNetTeacher":
        """Move the network to a device."""
        self._network.to(device)
        return self

    @property
    def device(self) -> torch.device:
        """Device of the network."""
        return next(chain(self._network.parameters(), self._network.buffers())).device

    @torch.no_grad()
    def __call__(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F h w"]:
        """Features of sRGB images in [0, 1], one per 16 pixels, rounded up."""
        features: Tensor = self._network(replicate_to_multiple(image, CELL))
        return features


def load_teacher(path: Path) -> MobileNetTeacher:
    """MobileNetV2 (`features.N`, up to block 13) or DeepLab's backbone (`backbone.N`, folded, up to block 17)."""
    tensors, _ = read_weights(path)
    if "backbone.17.conv.2.weight" in tensors:
        folded = fold(tensors, "backbone.", TENSORFLOW_EPS)
        network = MobileNetV2(folded, layout=DEEPLAB, last=17, same=True, mean=GREY, std=GREY)
        return MobileNetTeacher("deeplab-mobilenetv2:backbone.17", network)
    if "features.13.conv.3.running_var" in tensors:
        folded = fold(tensors, "features.", TENSORFLOW_EPS)
        network = MobileNetV2(folded, layout=CLASSIFIER, last=13, same=True, mean=GREY, std=GREY)
        return MobileNetTeacher("mobilenetv2:features.13", network)
    raise WeightsError(f"{path}: neither MobileNetV2 (features.N) nor DeepLab's MobileNetV2 backbone (backbone.N)")
