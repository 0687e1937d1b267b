"""Untrained convolutions drawn from a seed."""

from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ...interfaces import Encoder
from .frozen import freeze, reflect_pad, replicate_to_multiple

__all__ = ["RandomEncoder"]


class RandomEncoder(Encoder):
    """Means over cells of `stride` pixels, then a 3x3 convolution with weights ~ N(0, 1/27), then tanh."""

    def __init__(self, *, channels: int, stride: int, seed: int) -> None:
        super().__init__()
        self._settings = (channels, stride, seed)
        generator = torch.Generator().manual_seed(seed)
        self.register_buffer("weight", torch.randn(channels, 3, 3, 3, generator=generator) / 27**0.5)
        freeze(self)

    @property
    def identity(self) -> str:
        """Name, channels, stride and seed: they fix the weights."""
        return "random:{}:stride{}:seed{}".format(*self._settings)

    @property
    def channels(self) -> int:
        """Channels of the features."""
        return self._settings[0]

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features in (-1, 1), one per cell of stride x stride pixels (the last may reach over the border)."""
        stride = self._settings[1]
        cells = F.avg_pool2d(replicate_to_multiple(image, stride), stride)
        return torch.tanh(F.conv2d(reflect_pad(4 * cells - 2), self.get_buffer("weight").to(cells)))
