"""VGG-16 and VGG-19 (Simonyan and Zisserman) up to any layer, plain or normalised as AdaIN and FPRF use them.

Normalised: every filter is divided by its mean activation on photographs, borders are mirrored; features are then O(1).
Pools round up, so that no pixel is lost: the last cell of an odd axis covers what is left.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ...errors import WeightsError
from ...interfaces import Encoder
from ..weightfiles import tensors_hash
from .frozen import freeze, reflect_pad

__all__ = ["CONVOLUTIONS", "VggEncoder", "reaches", "vgg_activations"]


def _places(depths: Sequence[int]) -> Mapping[str, int]:
    """Convolution and ReLU take two places, a pool one after each block."""
    names = [(block, index) for block, depth in enumerate(depths) for index in range(depth)]
    return {f"{block + 1}_{index + 1}": 2 * at + block for at, (block, index) in enumerate(names)}


CONVOLUTIONS: Mapping[str, Mapping[str, int]] = {"vgg16": _places((2, 2, 3, 3, 3)), "vgg19": _places((2, 2, 4, 4, 4))}
"""Place of each convolution in torchvision's `features`, by network."""


class VggEncoder(Encoder):
    """One layer of a VGG. `scale` [C] divides the features where they are normalised, None leaves them plain."""

    def __init__(
        self,
        network: str,
        layer: str,
        tensors: Mapping[str, Tensor],
        *,
        mean: Annotated[Tensor, "3"],
        std: Annotated[Tensor, "3"],
        scale: Annotated[Tensor, "C"] | None,
        source: str,
    ) -> None:
        super().__init__()
        self._network, self._layer, self._normalised = network, layer, scale is not None
        names = list(CONVOLUTIONS[network])
        self._names = names[: names.index(layer[4:]) + 1]
        for index, name in enumerate(self._names):
            self.register_buffer(f"weight{index}", _tensor(tensors, network, name, "weight", source))
            self.register_buffer(f"bias{index}", _tensor(tensors, network, name, "bias", source))
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float())
        self.register_buffer("scale", torch.ones(self.channels) if scale is None else scale.float())
        self._hash = tensors_hash(dict(self.named_buffers()))
        freeze(self)

    @property
    def identity(self) -> str:
        """Network, layer, normalisation and a hash of every tensor that is used."""
        return f"{self._network}:{self._layer}:{'normalised' if self._normalised else 'plain'}:{self._hash}"

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


def vgg_activations(encoder: VggEncoder, images: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "C"]:
    """Mean of each filter's ReLU output over images, in float64: what `scale` is made of."""
    return F.relu(encoder(images)).double().mean(dim=(0, 2, 3))


def reaches(tensors: Mapping[str, Tensor], network: str) -> list[str]:
    """Layers whose convolutions, and all before them, are there."""
    found = []
    for name, place in CONVOLUTIONS[network].items():
        if f"features.{place}.weight" not in tensors or f"features.{place}.bias" not in tensors:
            break
        found.append(f"relu{name}")
    return found


def _tensor(tensors: Mapping[str, Tensor], network: str, name: str, part: str, source: str) -> Tensor:
    key = f"features.{CONVOLUTIONS[network][name]}.{part}"
    shown = network.upper().replace("VGG", "VGG-")
    if key not in tensors:
        held = reaches(tensors, network)
        raise WeightsError(
            f"{source}: holds no conv{name} ({key} is missing); its layers are {', '.join(held) or f'none of {shown}'}; "
            "choose one of these, or name a file that reaches further with --content.encoder.weights FILE"
        )
    value = tensors[key].float()
    if part == "weight" and (value.ndim != 4 or value.shape[2:] != (3, 3) or not math.isfinite(float(value.sum()))):
        raise WeightsError(f"{source}: {key} has shape {tuple(value.shape)}, not that of a 3x3 convolution of {shown}")
    return value
