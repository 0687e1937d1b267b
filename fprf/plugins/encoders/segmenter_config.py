"""Configs of the networks whose features say what things are: a classifier's and two segmenters'. `build` imports them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ...errors import ConfigError
from ..config import Need
from .config import EncoderConfig

if TYPE_CHECKING:
    from ...interfaces import Encoder

__all__ = ["DeepLabConfig", "EspNetConfig", "MobileNetV2Config"]


@dataclass(frozen=True, kw_only=True)
class MobileNetV2Config(EncoderConfig):
    """MobileNetV2 of ImageNet. torchvision's weights are downloaded once, unless named."""

    layer: str = "features.13"
    """features.N, N in 0..18; pixels per feature: 2 to N = 1, 4 to 3, 8 to 6, 16 to 13, then 32."""
    weights: Path | None = None
    """torchvision's mobilenet_v2-b0353104.pth, or a safetensors file with its keys, whose metadata may name another mean,
    std, bn_eps and padding. By default the download cache."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"features\.(\d|1[0-8])", self.layer):
            raise ConfigError(f"layer: {self.layer!r} is no layer of MobileNetV2; allowed are features.0 ... features.18")

    def needs(self) -> tuple[Need, ...]:
        """The weights."""
        from .mobilenet import SOURCE
        from .weight_sources import weights_needed

        return weights_needed(SOURCE, self.weights)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where weights are missing or end before the layer."""
        from .mobilenet import build_mobilenet

        return build_mobilenet(self.layer, weights=self.weights)


@dataclass(frozen=True, kw_only=True)
class DeepLabConfig(EncoderConfig):
    """DeepLabv3 on MobileNetV2, trained on the things of PASCAL VOC."""

    layer: str = "backbone.17"
    """backbone.N, N in 0..17, or logits (one score a class); pixels per feature: 2 to N = 1, 4 to 3, 8 to 6, then 16."""
    weights: Path | None = None
    """A safetensors file with the keys that docs/encoders.md names. By default the one in the weights cache."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"backbone\.(\d|1[0-7])|logits", self.layer):
            raise ConfigError(
                f"layer: {self.layer!r} is no layer of DeepLabv3; allowed are backbone.0 ... backbone.17 and logits"
            )

    def needs(self) -> tuple[Need, ...]:
        """The weights."""
        from .deeplab import SOURCE
        from .weight_sources import weights_needed

        return weights_needed(SOURCE, self.weights)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where weights are missing or lack the layer."""
        from .deeplab import build_deeplab

        return build_deeplab(self.layer, weights=self.weights)


@dataclass(frozen=True, kw_only=True)
class EspNetConfig(EncoderConfig):
    """ESPNetv2, trained on streets or on PASCAL VOC, as its weights were."""

    layer: Literal["level1", "level2", "level3", "level4", "logits"] = "level4"
    """Level of the base network, with 2, 4, 8 or 16 pixels per feature, or the scores of the classes, with 2."""
    weights: Path | None = None
    """EdgeNets' espnetv2_s_2.0_city_1024x512.pth or espnetv2_s_2.0_pascal_384x384.pth, or a safetensors file with their keys.
    By default the second, in the weights cache."""

    def needs(self) -> tuple[Need, ...]:
        """The weights."""
        from .espnet import SOURCE
        from .weight_sources import weights_needed

        return weights_needed(SOURCE, self.weights)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where weights are missing or lack the layer."""
        from .espnet import build_espnet

        return build_espnet(self.layer, weights=self.weights)
