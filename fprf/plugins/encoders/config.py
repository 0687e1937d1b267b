"""Encoder configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ..config import PluginConfig

if TYPE_CHECKING:
    from ...interfaces import Encoder

__all__ = ["EncoderConfig"]


@dataclass(frozen=True, kw_only=True)
class EncoderConfig(PluginConfig):
    """Turns images into features, for content or for semantics."""

    group: ClassVar[str] = "fprf.encoders"

    def build(self) -> Encoder:
        """The frozen encoder. Raises WeightsError where weights are missing."""
        raise NotImplementedError
