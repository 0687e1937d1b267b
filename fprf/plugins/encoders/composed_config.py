"""Configs of encoders that are made of encoders. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ...checks import positive
from ...errors import ConfigError
from .config import BundledContentConfig, BundledSemanticConfig, EncoderConfig

if TYPE_CHECKING:
    from ...interfaces import Encoder

__all__ = ["AveragedConfig", "ConcatConfig"]


@dataclass(frozen=True, kw_only=True)
class AveragedConfig(EncoderConfig):
    """Any encoder, averaged over the mirrored image and over several sizes of the image."""

    inner: EncoderConfig = BundledSemanticConfig()
    """The encoder that looks."""
    flip: bool = True
    """Average with the mirrored image's features, mirrored back."""
    scales: tuple[float, ...] = (1.0,)
    """Sizes at which the image is seen, as shares of its own; 2 halves the encoder's stride. The finest one's cells stay."""

    def __post_init__(self) -> None:
        if not self.scales:
            raise ConfigError("scales: needs at least one, as a share of the image's own size")
        for scale in self.scales:
            positive("scales", scale)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where the inner one's weights are missing."""
        from .averaged import AveragedEncoder

        return AveragedEncoder(self.inner.build(), flip=self.flip, scales=self.scales)


@dataclass(frozen=True, kw_only=True)
class ConcatConfig(EncoderConfig):
    """Two or three encoders side by side, each of unit length times its weight, at the finest one's stride."""

    first: EncoderConfig = BundledSemanticConfig()
    """An encoder."""
    second: EncoderConfig = BundledContentConfig()
    """Another one; `concat` itself for more than three."""
    third: EncoderConfig | None = None
    """A third one; none = two."""
    weights: tuple[float, ...] = ()
    """Weight of each, in their order: the root mean square length of its centred features; 1 for those left out."""

    def __post_init__(self) -> None:
        for weight in self.weights:
            positive("weights", weight)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where a part's weights are missing, ConfigError for more weights than parts."""
        from .concat import build_concat

        parts = [part for part in (self.first, self.second, self.third) if part is not None]
        if len(self.weights) > len(parts):
            raise ConfigError(f"weights: {len(self.weights)} for {len(parts)} encoders; give one each at most")
        weights = (*self.weights, *(1.0,) * (len(parts) - len(self.weights)))
        return build_concat([part.build() for part in parts], weights)
