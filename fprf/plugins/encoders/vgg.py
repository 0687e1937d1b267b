"""VGG-19 (Simonyan and Zisserman) up to any layer, plain or normalised as AdaIN and FPRF use it.

Normalised: every filter is divided by its mean activation on photographs, borders are mirrored; features are then O(1).
Pools round up, so that no pixel is lost: the last cell of an odd axis covers what is left.
"""

import math
from collections.abc import Mapping
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ...errors import WeightsError
from ...interfaces import Encoder
from ..weightfiles import tensors_hash
from .frozen import freeze, reflect_pad

__all__ = ["CONVOLUTIONS", "Vgg19Encoder", "reaches", "vgg19_activations"]

CONVOLUTIONS: Mapping[str, int] = {
    "1_1": 0, "1_2": 2,
    "2_1": 5, "2_2": 7,
    "3_1": 10, "3_2": 12, "3_3": 14, "3_4": 16,
    "4_1": 19, "4_2": 21, "4_3": 23, "4_4": 25,
    "5_1": 28, "5_2": 30, "5_3": 32, "5_4": 34,
}  # fmt: skip
"""Place of each convolution in torchvision's `features`."""


class Vgg19Encoder(Encoder):
    """One layer of VGG-19. `scale` [C] divides the features where they are normalised, None leaves them plain."""

    def __init__(
        self,
        layer: str,
        tensors: Mapping[str, Tensor],
        *,
        mean: Annotated[Tensor, "3"],
        std: Annotated[Tensor, "3"],
        scale: Annotated[Tensor, "C"] | None,
        source: str,
    ) -> None:
        super().__init__()
        self._layer, self._normalised = layer, scale is not None
        self._names = _names_up_to(layer[4:])
        for index, name in enumerate(self._names):
            self.register_buffer(f"weight{index}", _tensor(tensors, name, "weight", source))
            self.register_buffer(f"bias{index}", _tensor(tensors, name, "bias", source))
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float())
        self.register_buffer("scale", torch.ones(self.channels) if scale is None else scale.float())
        self._hash = tensors_hash(dict(self.named_buffers()))
        freeze(self)

    @property
    def identity(self) -> str:
        """Layer, normalisation and a hash of every tensor that is used."""
        return f"vgg19:{self._layer}:{'normalised' if self._normalised else 'plain'}:{self._hash}"

    @property
    def channels(self) -> int:
        """64, 128, 256 or 512."""
        return int(self.get_buffer(f"weight{len(self._names) - 1}").shape[0])

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features at stride 1, 2, 4, 8 or 16, by the block of the layer."""
        x = (image - self._column("mean", image)) / self._column("std", image)
        for index, name in enumerate(self._names):
            if index and name.endswith("_1"):
                x = F.max_pool2d(x, 2, ceil_mode=True)
            x = reflect_pad(x) if self._normalised else F.pad(x, (1, 1, 1, 1))
            x = F.conv2d(x, self.get_buffer(f"weight{index}").to(x), self.get_buffer(f"bias{index}").to(x))
            if index < len(self._names) - 1 or self._layer.startswith("relu"):
                x = F.relu(x)
        return x / self._column("scale", x)

    def _column(self, name: str, like: Tensor) -> Tensor:
        return self.get_buffer(name).to(like).view(1, -1, 1, 1)


def vgg19_activations(encoder: Vgg19Encoder, images: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "C"]:
    """Mean of each filter's ReLU output over images, in float64: what `scale` is made of."""
    return F.relu(encoder(images)).double().mean(dim=(0, 2, 3))


def reaches(tensors: Mapping[str, Tensor]) -> list[str]:
    """Layers whose convolutions, and all before them, are there."""
    found = []
    for name, place in CONVOLUTIONS.items():
        if f"features.{place}.weight" not in tensors or f"features.{place}.bias" not in tensors:
            break
        found.append(f"relu{name}")
    return found


def _names_up_to(last: str) -> list[str]:
    names = list(CONVOLUTIONS)
    return names[: names.index(last) + 1]


def _tensor(tensors: Mapping[str, Tensor], name: str, part: str, source: str) -> Tensor:
    key = f"features.{CONVOLUTIONS[name]}.{part}"
    if key not in tensors:
        held = reaches(tensors)
        raise WeightsError(
            f"{source}: holds no conv{name} ({key} is missing); its layers are {', '.join(held) or 'none of VGG-19'}; "
            "choose one of these, or name a file that reaches further with --content.encoder.weights FILE"
        )
    value = tensors[key].float()
    if part == "weight" and (value.ndim != 4 or value.shape[2:] != (3, 3) or not math.isfinite(float(value.sum()))):
        raise WeightsError(f"{source}: {key} has shape {tuple(value.shape)}, not that of a 3x3 convolution of VGG-19")
    return value
