"""Configs: defaults, ranges, and nothing heavy imported."""

import subprocess
import sys
from dataclasses import fields

from fprf.plugins import registry
from fprf.plugins.encoders import config
from fprf.plugins.encoders.config import (
    AveragedConfig,
    ConcatConfig,
    EncoderConfig,
)

ALL = [getattr(config, name) for name in config.__all__ if name != "EncoderConfig"]


def test_importing_the_configs_imports_no_torch() -> None:
    code = f"import sys, {config.__name__}; assert not {{'torch', 'numpy', 'cv2'}} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_config_is_an_entry_point() -> None:
    names = {registry.name_of("fprf.encoders", kind) for kind in ALL}
    assert {"vgg16", "vgg19", "mobilenet-v2", "deeplab", "espnet", "dino", "dinov2", "dinov3", "averaged", "concat"} < names


def test_parts_default_to_what_ships() -> None:
    """Composed encoders build without a file or a network."""
    for kind in (AveragedConfig, ConcatConfig):
        parts = [getattr(kind(), field.name) for field in fields(kind)]
        shipped = [part for part in parts if isinstance(part, EncoderConfig)]
        assert shipped and all(part.build().channels > 0 for part in shipped)
