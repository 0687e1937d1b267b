"""Configs: defaults, ranges, and nothing heavy imported."""

import subprocess
import sys
from dataclasses import fields
from typing import Any

import pytest

from fprf.errors import ConfigError
from fprf.plugins import registry
from fprf.plugins.encoders import config
from fprf.plugins.encoders.config import (
    AveragedConfig,
    ConcatConfig,
    DeepLabConfig,
    Dinov2Config,
    Dinov3Config,
    EncoderConfig,
    MobileNetV2Config,
    RandomConfig,
    Vgg16Config,
    Vgg19Config,
)

ALL = [getattr(config, name) for name in config.__all__ if name != "EncoderConfig"]


def test_importing_the_configs_imports_no_torch() -> None:
    code = f"import sys, {config.__name__}; assert not {{'torch', 'numpy', 'cv2'}} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_config_is_an_entry_point() -> None:
    names = {registry.name_of("fprf.encoders", kind) for kind in ALL}
    assert {"vgg16", "vgg19", "mobilenet-v2", "deeplab", "espnet", "dino", "dinov2", "dinov3", "averaged", "concat"} < names


@pytest.mark.parametrize("kind", ALL)
def test_every_config_has_defaults_and_belongs_to_the_group(kind: type[EncoderConfig]) -> None:
    assert kind().group == "fprf.encoders"
    assert kind() == kind()


@pytest.mark.parametrize("layer", ["relu0_1", "relu2_3", "relu6_1", "conv", "relu2_1 ", "fc7"])
def test_a_layer_that_vgg_lacks_is_refused(layer: str) -> None:
    with pytest.raises(ConfigError, match="relu1_1"):
        Vgg19Config(layer=layer)


@pytest.mark.parametrize("layer", ["conv1_1", "relu1_2", "relu3_4", "relu5_4"])
def test_layers_of_vgg_are_taken(layer: str) -> None:
    assert Vgg19Config(layer=layer).layer == layer
    if layer.endswith("_4"):
        with pytest.raises(ConfigError, match="relu5_3"):
            Vgg16Config(layer=layer)


@pytest.mark.parametrize(
    ("kind", "taken", "refused"),
    [
        (MobileNetV2Config, ["features.0", "features.9", "features.18"], ["features.19", "features.", "13", "features.013"]),
        (DeepLabConfig, ["backbone.0", "backbone.17", "logits"], ["backbone.18", "head", "logits2", "features.3"]),
    ],
)
def test_layers_of_the_others(kind: Any, taken: list[str], refused: list[str]) -> None:
    for layer in taken:
        assert kind(layer=layer).layer == layer
    for layer in refused:
        with pytest.raises(ConfigError, match=r"^layer: .*allowed are"):
            kind(layer=layer)


def test_parts_default_to_what_ships() -> None:
    """Composed encoders build without a file or a network."""
    for kind in (AveragedConfig, ConcatConfig):
        parts = [getattr(kind(), field.name) for field in fields(kind)]
        shipped = [part for part in parts if isinstance(part, EncoderConfig)]
        assert shipped and all(part.build().channels > 0 for part in shipped)


def test_ranges() -> None:
    for wrong in ({"channels": 0}, {"stride": 0}, {"seed": -1}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            RandomConfig(**wrong)
    with pytest.raises(ConfigError, match="layer: 0"):
        Dinov2Config(layer=0)
    with pytest.raises(ConfigError, match="layer: 0"):
        Dinov3Config(layer=0)
    with pytest.raises(ConfigError, match="stride"):
        Dinov2Config(stride=0)


def test_the_base_builds_nothing() -> None:
    with pytest.raises(NotImplementedError):
        EncoderConfig().build()
