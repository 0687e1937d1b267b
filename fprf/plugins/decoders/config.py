"""Decoder configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from ...checks import at_least, positive
from ..config import Need, PluginConfig, absent_file

if TYPE_CHECKING:
    from ...interfaces import Decoder

__all__ = ["DecoderConfig", "MlpDecoderConfig", "Objective", "ResidualDecoderConfig"]

Objective = Literal["identity", "paper"]
"""Training objective of a decoder: returning photographs alone, or the paper's content and style losses as well."""


@dataclass(frozen=True, kw_only=True)
class DecoderConfig(PluginConfig):
    """Turns content features into colour, point by point."""

    group: ClassVar[str] = "fprf.decoders"

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        """The decoder of that encoder (its `identity`). What a scene adds starts from the seed; the rest comes frozen.

        Raises WeightsError where none fits.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class MlpDecoderConfig(DecoderConfig):
    """D_VGG of the paper: a small network, trained once on photographs, frozen ever after."""

    weights: Path | None = None
    """A decoder made by `fprf pretrain decoder`. By default one that ships for the chosen encoder."""
    objective: Objective = "identity"
    """Objective that the shipped decoder was trained with: returning photographs alone, or the paper's content and style losses
    (L_c + lambda L_s) as well. Not used where `weights` names a file."""

    def needs(self) -> tuple[Need, ...]:
        """The file, where one is named; whether it fits the encoder is found when it is read."""
        return absent_file(self.weights)

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        from .decoders import load_decoder

        return load_decoder(self.weights, encoder=encoder, channels=channels, objective=self.objective)


@dataclass(frozen=True, kw_only=True)
class ResidualDecoderConfig(DecoderConfig):
    """The frozen decoder and a small colour head that every scene trains for itself; a style fades the head out."""

    weights: Path | None = None
    """A decoder made by `fprf pretrain decoder`. By default the one that ships for the chosen encoder."""
    hidden: int = 32
    """Hidden units of the head."""
    fade: float = 0.5
    """Change of the decoded colour, in logits, at which a full style leaves 1/e of the head's share."""

    def __post_init__(self) -> None:
        at_least("hidden", self.hidden, 1)
        positive("fade", self.fade)

    def needs(self) -> tuple[Need, ...]:
        """The file, where one is named; whether it fits the encoder is found when it is read."""
        return absent_file(self.weights)

    def build(self, *, encoder: str, channels: int, seed: int = 0) -> Decoder:
        import torch

        from .decoders import ResidualDecoder, load_decoder

        frozen = load_decoder(self.weights, encoder=encoder, channels=channels)
        generator = torch.Generator().manual_seed(seed)
        return ResidualDecoder(frozen, hidden=self.hidden, fade=self.fade, generator=generator)
