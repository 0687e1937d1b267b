"""The network: images [B 3 H W] to features [B C h w]."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from fprf.interfaces import Encoder

if TYPE_CHECKING:
    from . import ContrastConfig

__all__ = ["ContrastEncoder"]


class ContrastEncoder(Encoder):
    """Differences of the three colours from their mean around a pixel."""

    def __init__(self, config: ContrastConfig) -> None:
        super().__init__()
        self._config = config

    @property
    def identity(self) -> str:
        """Name and every setting that changes the features: caches and saved scenes are kept by it."""
        return f"contrast:{self._config.window}"

    @property
    def channels(self) -> int:
        """One a colour."""
        return 3

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B 3 H W"]:
        """Features in [-1, 1] of sRGB images in [0, 1]; fewer cells than pixels are as good."""
        before = self._config.window // 2
        after = self._config.window - 1 - before
        around = pad(image, (before, after, before, after), mode="replicate")
        return image - avg_pool2d(around, self._config.window, stride=1)
