"""A Gabor filter bank as an encoder for fprf, a loss on opacity, and a method. Importing this imports no
torch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from fprf.checks import at_least
from fprf.config import TrainConfig
from fprf.errors import ConfigError
from fprf.methods import fprf_lite
from fprf.plugins.encoders.config import EncoderConfig
from fprf.plugins.losses.config import LossTermConfig

if TYPE_CHECKING:
    from fprf.interfaces import Encoder, LossTerm

__all__ = ["GaborConfig", "OpacityConfig", "fprf_gabor"]


@dataclass(frozen=True, kw_only=True)
class GaborConfig(EncoderConfig):
    """Texture energy in bands and directions, beside the colour: no weights, nothing to download."""

    orientations: int = 4
    """Directions of the filters, spread evenly over half a turn."""
    wavelengths: tuple[float, ...] = (4.0, 8.0)
    """Wavelengths of the filters in pixels, each at least 2."""
    stride: int = 4
    """Pixels per feature."""

    def __post_init__(self) -> None:
        at_least("orientations", self.orientations, 1)
        at_least("stride", self.stride, 1)
        if not self.wavelengths:
            raise ConfigError("wavelengths: needs at least one, in pixels")
        for wavelength in self.wavelengths:
            at_least("wavelengths", wavelength, 2.0)

    def build(self) -> Encoder:
        """The encoder."""
        from .bank import GaborEncoder

        return GaborEncoder(self)


@dataclass(frozen=True, kw_only=True)
class OpacityConfig(LossTermConfig):
    """Push the opacity of rays to 0 or 1: for objects before an empty background, against half-transparent
    haze.
    """

    weight: float = 0.01
    """Weight of the term, which is 1 for rays of opacity 0.5 and 0 for those of opacity 0 or 1."""

    def build(self) -> LossTerm:
        """The term."""
        from .opacity import OpacityTerm

        return OpacityTerm()


def fprf_gabor() -> TrainConfig:
    """fprf-lite with Gabor features as semantics: what looks alike in texture and colour is styled alike."""
    lite = fprf_lite()
    return replace(lite, semantic=replace(lite.semantic, encoder=GaborConfig(), dim=11))
