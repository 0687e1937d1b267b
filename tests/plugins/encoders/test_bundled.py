"""The encoders that ship: small, quick to load, and no file of another kind in their place."""

from pathlib import Path

import pytest
import torch

from fprf.errors import WeightsError
from fprf.plugins.decoders.decoders import FOLDER as DECODERS
from fprf.plugins.encoders.bundled import CONTENT_KIND, FOLDER, SEMANTIC_KIND
from fprf.plugins.encoders.config import BundledContentConfig, BundledSemanticConfig
from fprf.plugins.encoders.dinov2 import WEIGHTS as DINOV2
from fprf.plugins.weights import read_weights, write_weights


def test_everything_that_ships_stays_small_and_says_what_it_is() -> None:
    files = [*FOLDER.glob("*.safetensors"), *DECODERS.glob("*.safetensors")]
    assert len(files) >= 4
    assert sum(file.stat().st_size for file in files if file != DINOV2) < 3e6
    assert DINOV2.stat().st_size < 21e6
    for file in files:
        metadata = read_weights(file)[1]
        if file == DINOV2:
            assert "Apache-2.0" in metadata["licence"] and "Meta AI" in metadata["licence"]
            continue
        if file.stem == "vgg19-relu2_1" and file.parent == FOLDER:
            assert "CC BY 4.0" in metadata["licence"] and "Simonyan" in metadata["licence"]
            continue
        assert metadata["made_by"].startswith("fprf pretrain ")
        assert "Apache-2.0" in metadata["licence"]


@pytest.mark.parametrize(("config", "kind"), [(BundledContentConfig, CONTENT_KIND), (BundledSemanticConfig, SEMANTIC_KIND)])
def test_other_files_are_refused_with_the_command_that_makes_the_right_one(
    config: type[BundledContentConfig], kind: str, tmp_path: Path
) -> None:
    write_weights(tmp_path / "other.safetensors", {"project.weight": torch.zeros(3, 3, 1, 1)}, {"kind": "mlp-decoder"})
    with pytest.raises(WeightsError, match=f"'mlp-decoder'.*tools.distil {kind.removeprefix('bundled-')}"):
        config(weights=tmp_path / "other.safetensors").build()
    write_weights(tmp_path / "shape.safetensors", {"project.weight": torch.zeros(3, 3, 1, 1)}, {"kind": kind})
    for name in ("shape", "absent"):
        with pytest.raises(WeightsError, match=name):
            config(weights=tmp_path / f"{name}.safetensors").build()


def test_the_semantic_encoder_sees_the_whole_image() -> None:
    encoder = BundledSemanticConfig().build()
    image = torch.full((1, 3, 256, 256), 0.4)
    other = image.clone()
    other[..., 200:] = torch.tensor([0.2, 0.6, 0.1]).view(1, 3, 1, 1)
    assert not torch.allclose(encoder(image)[..., :4], encoder(other)[..., :4], atol=1e-3)
