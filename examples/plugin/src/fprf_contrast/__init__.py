"""An encoder for fprf. Importing this imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fprf.checks import at_least
from fprf.plugins.encoders.config import EncoderConfig

if TYPE_CHECKING:
    from fprf.interfaces import Encoder

__all__ = ["ContrastConfig"]


@dataclass(frozen=True, kw_only=True)
class ContrastConfig(EncoderConfig):
    """Difference of each pixel from its surroundings: no weights, nothing to download."""

    window: int = 9
    """Side of the surroundings, in pixels."""

    def __post_init__(self) -> None:
        at_least("window", self.window, 1)

    def build(self) -> Encoder:
        """The encoder."""
        from .encoder import ContrastEncoder

        return ContrastEncoder(self).eval()
