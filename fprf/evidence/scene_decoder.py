"""What the frozen decoder is compared with: one that every scene trains for itself, from nothing. For tables alone.

It is no plug-in: a decoder that has seen one scene knows nothing of the features that another style brings.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from ..interfaces import Decoder
from ..plugins.decoders.config import DecoderConfig, MlpDecoderConfig
from ..plugins.decoders.residual import ColourHead

__all__ = ["SceneDecoder", "SceneDecoderConfig"]


@dataclass(frozen=True, kw_only=True)
class SceneDecoderConfig(DecoderConfig):
    """A network of the shipped decoder's size, trained with the scene."""

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        """As large as the shipped decoder of that encoder; starts from the seed."""
        from ..plugins.decoders.mlp import load_decoder

        hidden = load_decoder(MlpDecoderConfig().weights, encoder=encoder, channels=channels).first.out_features
        return SceneDecoder(channels, hidden, torch.Generator().manual_seed(seed))


class SceneDecoder(Decoder):
    """rgb = sigmoid(head(content)), every weight the scene's own."""

    def __init__(self, channels: int, hidden: int, generator: torch.Generator) -> None:
        super().__init__()
        self.head = ColourHead(channels, hidden, generator)

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        """sRGB in [0, 1]; grey before it is trained."""
        return torch.sigmoid(self.head(content))

    def restyled(
        self,
        content: Annotated[Tensor, "N C"],
        styled: Annotated[Tensor, "N C"],
        strength: float | Annotated[Tensor, "N 1"],
    ) -> Annotated[Tensor, "N 3"]:
        """The decoded style."""
        colour: Tensor = self(styled)
        return colour

    def unaided(self, content: Annotated[Tensor, "N C"]) -> None:
        """None: there is nothing besides."""
