"""An encoder averaged over mirrored and resized images: steadier, and finer where a size is above 1."""

from collections.abc import Sequence
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ...interfaces import Encoder
from .frozen import finest, freeze

__all__ = ["AveragedEncoder"]


class AveragedEncoder(Encoder):
    """Mean of `inner` over `scales` of the image, and over its mirror images if `flip`."""

    def __init__(self, inner: Encoder, *, flip: bool, scales: Sequence[float]) -> None:
        super().__init__()
        self.inner = inner
        self._flip, self._scales = flip, tuple(scales)
        freeze(self)

    @property
    def identity(self) -> str:
        """What is averaged, and the inner encoder's identity."""
        sizes = "+".join(repr(scale) for scale in self._scales)
        return f"averaged:{'flip' if self._flip else 'plain'}:{sizes}:[{self.inner.identity}]"

    @property
    def channels(self) -> int:
        """The inner encoder's."""
        return self.inner.channels

    @torch.no_grad()
    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B C h w"]:
        """Features on the cells of the finest view."""
        return torch.stack(finest([self._look(image, scale) for scale in self._scales])).mean(dim=0)

    def _look(self, image: Tensor, scale: float) -> Tensor:
        size = tuple(max(1, round(n * scale)) for n in image.shape[-2:])
        if size != tuple(image.shape[-2:]):
            image = F.interpolate(image, size, mode="bilinear", align_corners=False, antialias=True)
        features: Tensor = self.inner(image)
        if self._flip:
            mirrored: Tensor = self.inner(image.flip(-1)).flip(-1)
            features = (features + mirrored) / 2
        return features
