"""Encoder configs. `build` imports the implementation."""

from __future__ import annotations

import importlib.util
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from ...checks import at_least
from ...errors import ConfigError
from ..config import Need, PluginConfig, absent_file

if TYPE_CHECKING:
    from ...interfaces import Encoder

__all__ = [
    "BundledContentConfig",
    "BundledSemanticConfig",
    "DinoConfig",
    "Dinov2Config",
    "Dinov3Config",
    "EncoderConfig",
    "RandomConfig",
    "Vgg16Config",
    "Vgg19Config",
]


@dataclass(frozen=True, kw_only=True)
class EncoderConfig(PluginConfig):
    """Turns images into features, for content or for semantics."""

    group: ClassVar[str] = "fprf.encoders"

    def build(self) -> Encoder:
        """The frozen encoder. Raises WeightsError where weights are missing."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class BundledContentConfig(EncoderConfig):
    """Ships with the package: a small network that imitates the principal components of VGG-19 relu2_1, stride 2."""

    weights: Path | None = None
    """A file made by `fprf pretrain content`. By default the one that ships."""

    def needs(self) -> tuple[Need, ...]:
        """The file, where one is named."""
        return absent_file(self.weights)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where the file is absent or no content encoder."""
        from .bundled import load_content_encoder

        return load_content_encoder(self.weights)


@dataclass(frozen=True, kw_only=True)
class BundledSemanticConfig(EncoderConfig):
    """Ships with the package: a small network distilled from MobileNet-class features, stride 8, steady in any light."""

    weights: Path | None = None
    """A file made by `fprf pretrain semantic`. By default the one that ships."""

    def needs(self) -> tuple[Need, ...]:
        """The file, where one is named."""
        return absent_file(self.weights)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where the file is absent or no semantic encoder."""
        from .bundled import load_semantic_encoder

        return load_semantic_encoder(self.weights)


@dataclass(frozen=True, kw_only=True)
class Vgg16Config(EncoderConfig):
    """VGG-16 of ImageNet. torchvision's weights are downloaded once, unless named."""

    layer: str = "relu2_1"
    """convX_Y or reluX_Y, X in 1..5: up to where the weights reach."""
    weights: Path | None = None
    """torchvision's vgg16-397923af.pth, Caffe's vgg16-00b39a1b.pth, or a safetensors file with their keys. By default the
    download cache."""
    normalise: bool = True
    """Divide every filter by its mean activation on photographs, reflect at borders (AdaIN, FPRF); else plain VGG."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"(conv|relu)([12]_[12]|[345]_[1-3])", self.layer):
            raise ConfigError(f"layer: {self.layer!r} is no layer of VGG-16; allowed are conv1_1, relu1_1 ... relu5_3")

    def needs(self) -> tuple[Need, ...]:
        """The weights."""
        from .vgg_weights import SOURCES
        from .weight_sources import weights_needed

        return weights_needed(SOURCES["vgg16"], self.weights)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where weights are missing or end before the layer."""
        from .vgg_weights import build_vgg16

        return build_vgg16(self.layer, weights=self.weights, normalise=self.normalise)


@dataclass(frozen=True, kw_only=True)
class Vgg19Config(EncoderConfig):
    """VGG-19 of ImageNet, the paper's content encoder. Ships up to relu2_1; torchvision's weights are downloaded for more."""

    layer: str = "relu2_1"
    """convX_Y or reluX_Y, X in 1..5: up to where the weights reach."""
    weights: Path | None = None
    """torchvision's vgg19-dcbb9e9d.pth, Caffe's vgg19-d01eb7cb.pth, AdaIN's vgg_normalised.pth, or a safetensors file with
    torchvision's keys. By default the file that ships up to relu2_1 (the original weights, for which decoders ship), beyond it
    the download cache."""
    normalise: bool = True
    """Divide every filter by its mean activation on photographs, reflect at borders (AdaIN, FPRF); else plain VGG."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"(conv|relu)([12]_[12]|[345]_[1-4])", self.layer):
            raise ConfigError(f"layer: {self.layer!r} is no layer of VGG-19; allowed are conv1_1, relu1_1 ... relu5_4")

    def needs(self) -> tuple[Need, ...]:
        """The weights, beyond the layers that ship."""
        from .vgg_weights import BUNDLED_LAYERS, SOURCES
        from .weight_sources import weights_needed

        ships = self.weights is None and self.layer[4:] in BUNDLED_LAYERS
        return () if ships else weights_needed(SOURCES["vgg19"], self.weights)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where weights are missing or end before the layer."""
        from .vgg_weights import build_vgg19

        return build_vgg19(self.layer, weights=self.weights, normalise=self.normalise)


@dataclass(frozen=True, kw_only=True)
class DinoConfig(EncoderConfig):
    """DINO, the paper's semantic encoder: a self-supervised vision transformer. Needs the extra `encoders`."""

    model: str = "facebook/dino-vits8"
    """A model of the Hugging Face hub, or a folder that holds one."""
    layer: int = -1
    """Block whose tokens are taken, from 1; negative counts from the last."""
    stride: int = 8
    """Pixels of the image per feature: the image is resized until one patch covers that many."""

    def __post_init__(self) -> None:
        _check_transformer(self.layer, self.stride)

    def needs(self) -> tuple[Need, ...]:
        """The package transformers, and the model."""
        return _transformer_needs(self.model)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where transformers or the model is absent."""
        from .vit import build_vit

        return build_vit("dino", self.model, layer=self.layer, stride=self.stride)


@dataclass(frozen=True, kw_only=True)
class Dinov2Config(EncoderConfig):
    """DINOv2: the successor, with steadier semantics. Needs the extra `encoders`."""

    model: str = "facebook/dinov2-small"
    """A model of the Hugging Face hub, or a folder that holds one."""
    layer: int = -1
    """Block whose tokens are taken, from 1; negative counts from the last."""
    stride: int = 8
    """Pixels of the image per feature: the image is resized until one patch covers that many."""

    def __post_init__(self) -> None:
        _check_transformer(self.layer, self.stride)

    def needs(self) -> tuple[Need, ...]:
        """The package transformers, and the model."""
        return _transformer_needs(self.model)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where transformers or the model is absent."""
        from .vit import build_vit

        return build_vit("dinov2", self.model, layer=self.layer, stride=self.stride)


@dataclass(frozen=True, kw_only=True)
class Dinov3Config(EncoderConfig):
    """DINOv3: the third of them, for dense features. Needs the extra `encoders`; its licence is accepted on the hub."""

    model: str = "facebook/dinov3-vits16-pretrain-lvd1689m"
    """A vision transformer of the Hugging Face hub, or a folder that holds one."""
    layer: int = -1
    """Block whose tokens are taken, from 1; negative counts from the last."""
    stride: int = 8
    """Pixels of the image per feature: the image is resized until one patch covers that many."""

    def __post_init__(self) -> None:
        _check_transformer(self.layer, self.stride)

    def needs(self) -> tuple[Need, ...]:
        """The package transformers, and the model."""
        return _transformer_needs(self.model)

    def build(self) -> Encoder:
        """The encoder. Raises WeightsError where transformers or the model is absent."""
        from .vit import build_vit

        return build_vit("dinov3", self.model, layer=self.layer, stride=self.stride)


@dataclass(frozen=True, kw_only=True)
class RandomConfig(EncoderConfig):
    """Untrained convolutions drawn from a seed: for tests, and as the floor in ablations."""

    channels: int = 16
    """Channels of the features."""
    stride: int = 4
    """Pixels per feature."""
    seed: int = 0
    """Another seed, other filters."""

    def __post_init__(self) -> None:
        at_least("channels", self.channels, 1)
        at_least("stride", self.stride, 1)
        at_least("seed", self.seed, 0)

    def build(self) -> Encoder:
        """The encoder."""
        from .random import RandomEncoder

        return RandomEncoder(channels=self.channels, stride=self.stride, seed=self.seed)


def _check_transformer(layer: int, stride: int) -> None:
    if layer == 0:
        raise ConfigError("layer: 0 is no block; allowed are 1, 2 ... from the first and -1, -2 ... from the last")
    at_least("stride", stride, 1)


def _transformer_needs(model: str) -> tuple[Need, ...]:
    found = []
    if importlib.util.find_spec("transformers") is None:
        ships = "or choose an encoder that ships: --semantic.encoder bundled-semantic"
        found.append(Need("the package transformers", f"pip install 'fprf[encoders]', {ships}"))
    hub = os.environ.get("HF_HUB_CACHE") or Path(os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface") / "hub"
    cached = any(Path(hub).glob(f"models--{model.replace('/', '--')}/snapshots/*/config.json"))
    if not cached and not (Path(model) / "config.json").is_file():
        found.append(Need(f"the model {model}", f"hf download {model}", downloaded=True))
    return tuple(found)
