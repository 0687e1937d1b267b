"""Where weights are looked for, and what is said where they are not."""

import shutil
import urllib.error
from pathlib import Path

import pytest
import torch
from network_files import deeplab_file, mobilenet_tensors

from fprf.errors import WeightsError
from fprf.plugins import weights
from fprf.plugins.encoders.config import DeepLabConfig, EncoderConfig, EspNetConfig, MobileNetV2Config
from fprf.plugins.encoders.mobilenet import DEEPLAB_SOURCE as DEEPLAB
from fprf.plugins.weights import find_weights


@pytest.fixture(autouse=True)
def home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A home of its own, and no network."""

    def refuse(*_: object, **__: object) -> None:
        raise urllib.error.URLError("no network in tests")

    monkeypatch.setattr(weights.urllib.request, "urlopen", refuse)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.mark.parametrize(
    ("config", "file"),
    [
        (MobileNetV2Config(), "mobilenet_v2-b0353104.pth"),
        (DeepLabConfig(), "deeplabv3_mobilenetv2_pascal.safetensors"),
        (EspNetConfig(), "espnetv2_s_2.0_pascal_384x384.pth"),
    ],
)
def test_missing_weights_name_file_folder_and_flag(config: EncoderConfig, file: str, home: Path) -> None:
    with pytest.raises(WeightsError) as raised:
        config.build()
    for part in (file, str(home / ".cache/fprf/weights"), "--semantic.encoder.weights FILE"):
        assert part in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("folder", [".cache/fprf/weights", ".cache/torch/hub/checkpoints"])
def test_both_caches_are_searched(folder: str, home: Path, tmp_path: Path) -> None:
    (home / folder).mkdir(parents=True)
    file = deeplab_file(tmp_path)
    shutil.copy(file, home / folder / DEEPLAB.file)
    assert find_weights(DEEPLAB, None) == home / folder / DEEPLAB.file
    assert DeepLabConfig().build().identity == DeepLabConfig(weights=file).build().identity


def test_the_hash_in_a_name_is_a_promise(home: Path) -> None:
    cache = home / ".cache/fprf/weights"
    cache.mkdir(parents=True)
    torch.save(mobilenet_tensors(folded=False), cache / "mobilenet_v2-b0353104.pth")
    with pytest.raises(WeightsError, match="promises b0353104; delete it and fetch https"):
        MobileNetV2Config().build()
