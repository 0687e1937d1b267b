"""Configs: defaults, ranges, and nothing heavy imported."""

import subprocess
import sys

import pytest

from fprf.errors import ConfigError
from fprf.plugins.encoders import config as configs
from fprf.plugins.encoders.config import Dinov2Config, EncoderConfig, RandomConfig, Vgg19Config

ALL = [getattr(configs, name) for name in configs.__all__ if name != "EncoderConfig"]


def test_importing_the_configs_imports_no_torch() -> None:
    code = "import sys, fprf.plugins.encoders.config; assert not {'torch', 'numpy', 'cv2'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


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


def test_ranges() -> None:
    for wrong in ({"channels": 0}, {"stride": 0}, {"seed": -1}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            RandomConfig(**wrong)
    with pytest.raises(ConfigError, match="layer: 0"):
        Dinov2Config(layer=0)
    with pytest.raises(ConfigError, match="stride"):
        Dinov2Config(stride=0)


def test_the_base_builds_nothing() -> None:
    with pytest.raises(NotImplementedError):
        EncoderConfig().build()
