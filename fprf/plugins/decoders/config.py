"""Decoder configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from ..config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import Decoder

__all__ = ["DecoderConfig", "MlpDecoderConfig"]


@dataclass(frozen=True, kw_only=True)
class DecoderConfig(PluginConfig):
    """Turns content features into colour, point by point."""

    group: ClassVar[str] = "fprf.decoders"

    def build(self, *, encoder: str, channels: int) -> Decoder:
        """The frozen decoder of that encoder (its `identity`). Raises WeightsError where none fits."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class MlpDecoderConfig(DecoderConfig):
    """D_VGG of the paper: a small network, trained once on photographs, frozen ever after."""

    weights: Path | None = None
    """A decoder made by `fprf pretrain decoder`. By default the one that ships for the chosen encoder."""

    def build(self, *, encoder: str, channels: int) -> Decoder:
        """The decoder whose file names this encoder."""
        from .mlp import load_decoder

        return load_decoder(self.weights, encoder=encoder, channels=channels)
