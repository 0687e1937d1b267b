"""Encoder configs. `build` imports the implementation."""

from __future__ import annotations

import importlib.util
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from ...checks import at_least, positive
from ...errors import ConfigError
from ...io.cache import files_in, user_folder
from ..config import Need, PluginConfig, absent_file

if TYPE_CHECKING:
    from ...interfaces import Encoder


@dataclass(frozen=True, kw_only=True)
class EncoderConfig(PluginConfig):
    """Turns images into features, for content or for semantics."""

    group: ClassVar[str] = "fprf.encoders"

    def build(self) -> Encoder:
        """The frozen encoder. Raises WeightsError where weights are missing."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class BundledContentConfig(EncoderConfig):
    """Ships with the package: a small network that imitates the principal components of VGG-19 relu2_1,
    stride 2.
    """

    weights: Path | None = None
    """A file made by `python -m tools.distil content`. By default the one that ships."""

    def needs(self) -> tuple[Need, ...]:
        return absent_file(self.weights)

    def build(self) -> Encoder:
        from .bundled import load_content_encoder

        return load_content_encoder(self.weights)


@dataclass(frozen=True, kw_only=True)
class BundledSemanticConfig(EncoderConfig):
    """Ships with the package: a small network distilled from MobileNet-class features, stride 8, steady in
    any light.
    """

    weights: Path | None = None
    """A file made by `python -m tools.distil semantic`. By default the one that ships."""

    def needs(self) -> tuple[Need, ...]:
        return absent_file(self.weights)

    def build(self) -> Encoder:
        from .bundled import load_semantic_encoder

        return load_semantic_encoder(self.weights)


@dataclass(frozen=True, kw_only=True)
class Vgg19Config(EncoderConfig):
    """VGG-19 of ImageNet, the paper's content encoder. Ships up to relu2_1; torchvision's weights are
    downloaded for more.
    """

    layer: str = "relu2_1"
    """convX_Y or reluX_Y, X in 1..5: up to where the weights reach."""
    weights: Path | None = None
    """torchvision's vgg19-dcbb9e9d.pth, AdaIN's vgg_normalised.pth, or a safetensors file with torchvision's
    keys. By default the file that ships up to relu2_1 (the original weights, for which decoders ship), beyond
    it the download cache.
    """
    normalise: bool = True
    """Divide every filter by its mean activation on photographs, reflect at borders (AdaIN, FPRF); else plain
    VGG.
    """

    def __post_init__(self) -> None:
        if not re.fullmatch(r"(conv|relu)([12]_[12]|[345]_[1-4])", self.layer):
            raise ConfigError(
                f"layer: {self.layer!r} is no layer of VGG-19; allowed are conv1_1, relu1_1 ... relu5_4"
            )

    def needs(self) -> tuple[Need, ...]:
        from .vgg import weights_needed

        return weights_needed(self.layer, self.weights)

    def build(self) -> Encoder:
        from .vgg import build_vgg

        return build_vgg(self.layer, weights=self.weights, normalise=self.normalise)


def hub_folder() -> Path:
    """Folder in which the library of the Hugging Face hub keeps models."""
    home = os.environ.get("HF_HOME") or user_folder("").parent / "huggingface"
    return Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub")


def _hub_needs(model: str) -> tuple[Need, ...]:
    """transformers, and a model of the hub that is neither cached nor a folder."""
    needs = []
    if importlib.util.find_spec("transformers") is None:
        ships = "or choose an encoder that ships: --semantic.encoder dinov2"
        needs.append(Need("the package transformers", f"pip install 'fprf[encoders]', {ships}"))
    cached = files_in(hub_folder(), f"models--{model.replace('/', '--')}/snapshots/*/config.json")
    if not cached and not (Path(model) / "config.json").is_file():
        needs.append(Need(f"the model {model}", f"hf download {model}", downloaded=True))
    return tuple(needs)


def _check_layer(layer: int) -> None:
    if layer == 0:
        raise ConfigError(
            "layer: 0 is no block; allowed are 1, 2 ... from the first and -1, -2 ... from the last"
        )


@dataclass(frozen=True, kw_only=True)
class _TransformerConfig(EncoderConfig):
    family: ClassVar[str]

    model: str
    """A model of the Hugging Face hub, or a folder that holds one."""
    layer: int = -1
    """Block whose tokens are taken, from 1; negative counts from the last."""
    stride: int = 8
    """Pixels of the image per feature: the image is resized until one patch covers that many."""

    def __post_init__(self) -> None:
        _check_layer(self.layer)
        at_least("stride", self.stride, 1)

    def needs(self) -> tuple[Need, ...]:
        return _hub_needs(self.model)

    def build(self) -> Encoder:
        from .vit import build_vit

        return build_vit(self.family, self.model, layer=self.layer, stride=self.stride)


@dataclass(frozen=True, kw_only=True)
class DinoConfig(_TransformerConfig):
    """DINO, the paper's semantic encoder: a self-supervised vision transformer. Needs the extra
    `encoders`.
    """

    family: ClassVar[str] = "dino"

    model: str = "facebook/dino-vits8"
    """A model of the Hugging Face hub, or a folder that holds one."""


@dataclass(frozen=True, kw_only=True)
class Dinov2Config(EncoderConfig):
    """DINOv2: a self-supervised vision transformer, DINO's successor. The small one ships; others need the
    extra `encoders`.
    """

    model: str | None = None
    """A model of the Hugging Face hub, for example facebook/dinov2-base, or a folder that holds one; none =
    the small one that ships, blocks 1 to 11.
    """
    layer: int = 9
    """Block whose features are taken, from 1; negative counts from the last."""
    features: Literal["tokens", "keys"] = "tokens"
    """The block's output, or the keys of its attention. A model of the hub gives tokens, which pass its final
    norm.
    """
    stride: int | None = None
    """Pixels of the image per feature: the image is resized until one patch covers that many. none = 22
    features along its longer side, whatever its size.
    """

    def __post_init__(self) -> None:
        _check_layer(self.layer)
        if self.stride is not None:
            at_least("stride", self.stride, 1)
        if self.model is not None and self.features != "tokens":
            raise ConfigError(
                f"features: {self.features!r} with the model {self.model}; only the one that ships has keys"
            )

    def needs(self) -> tuple[Need, ...]:
        if self.model is None:
            return ()
        return _hub_needs(self.model)

    def build(self) -> Encoder:
        if self.model is None:
            from .dinov2 import load_dinov2

            return load_dinov2(layer=self.layer, kind=self.features, stride=self.stride)
        from .vit import build_vit

        return build_vit("dinov2", self.model, layer=self.layer, stride=self.stride)


@dataclass(frozen=True, kw_only=True)
class Dinov3Config(_TransformerConfig):
    """DINOv3: the third of them, for dense features. Needs the extra `encoders`; its licence is accepted on
    the hub.
    """

    family: ClassVar[str] = "dinov3"

    model: str = "facebook/dinov3-vits16-pretrain-lvd1689m"
    """A vision transformer of the Hugging Face hub, or a folder that holds one."""


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
        from .bundled import RandomEncoder

        return RandomEncoder(channels=self.channels, stride=self.stride, seed=self.seed)


@dataclass(frozen=True, kw_only=True)
class ConcatConfig(EncoderConfig):
    """Two or three encoders side by side, each of unit length times its weight."""

    first: EncoderConfig = BundledSemanticConfig()
    """An encoder."""
    second: EncoderConfig = BundledContentConfig()
    """Another one; `concat` itself for more than three."""
    third: EncoderConfig | None = None
    """A third one; none = two."""
    weights: tuple[float, ...] = ()
    """Weight of each, in their order: the root mean square length of its centred features; 1 for those left
    out.
    """
    cells: Literal["finest", "first"] = "finest"
    """Whose cells the features have: coarser encoders are interpolated, finer ones averaged over them, which
    steadies them.
    """

    def __post_init__(self) -> None:
        for weight in self.weights:
            positive("weights", weight)

    def build(self) -> Encoder:
        from .composed import build_concat

        parts = []
        for part in (self.first, self.second, self.third):
            if part is not None:
                parts.append(part)
        if len(self.weights) > len(parts):
            raise ConfigError(
                f"weights: {len(self.weights)} for {len(parts)} encoders; give one each at most"
            )
        weights = (*self.weights, *(1.0,) * (len(parts) - len(self.weights)))
        return build_concat([part.build() for part in parts], weights, cells=self.cells)


SEMANTICS = ConcatConfig(first=Dinov2Config(), second=BundledSemanticConfig(), cells="first")
"""Semantics by default: what things are, by DINOv2, beside what is steady in any light. Together they find
the right region of more photographs than either (docs/encoders.md).
"""
