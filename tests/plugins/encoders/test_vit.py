"""DINO, DINOv2 and DINOv3: on small random models where transformers is installed; without it, one clear line."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor, nn

from fprf.errors import WeightsError
from fprf.plugins.encoders.config import DinoConfig, Dinov2Config, Dinov3Config, EncoderConfig
from fprf.plugins.encoders.vit import VitEncoder
from fprf.testing import check_encoder


class Patches(nn.Module):
    """A stand-in: tokens are the mean colours of the patches, after two tokens that stand for nothing."""

    def __init__(self, patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.used = nn.Parameter(torch.ones(1))
        self.pooler = nn.Linear(1, 1)

    def forward(self, pixel_values: Tensor, **_: bool) -> SimpleNamespace:
        cells = nn.functional.avg_pool2d(pixel_values, self.patch).flatten(2).transpose(1, 2)
        return SimpleNamespace(last_hidden_state=torch.cat([torch.full_like(cells[:, :2], 9), cells], dim=1))


def stand_in(stride: int, patch: int = 4) -> VitEncoder:
    return VitEncoder("dinov2", Patches(patch), name="stand-in", patch=patch, channels=3, stride=stride)


@pytest.mark.parametrize("stride", [2, 4, 7])
@pytest.mark.parametrize(("height", "width"), [(28, 56), (45, 31), (1, 3)])
def test_one_token_per_stride(stride: int, height: int, width: int) -> None:
    features = stand_in(stride)(torch.rand(2, 3, height, width))
    assert features.shape == (2, 3, max(1, round(height / stride)), max(1, round(width / stride)))
    assert features.max() < 9  # class and register tokens are gone


def test_tokens_lie_where_their_patch_is() -> None:
    image = torch.rand(1, 3, 16, 24)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    expected = (nn.functional.avg_pool2d(image, 4) - mean.view(1, 3, 1, 1)) / std.view(1, 3, 1, 1)
    torch.testing.assert_close(stand_in(4)(image), expected)


@pytest.mark.parametrize("config", [DinoConfig(), Dinov2Config(model="facebook/dinov2-small"), Dinov3Config()])
def test_without_transformers_one_line_says_what_to_do(config: EncoderConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(WeightsError, match=r"pip install 'fprf\[encoders\]'.*--semantic.encoder dinov2"):
        config.build()


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three blocks, 32 wide."""
    transformers = pytest.importorskip("transformers", reason="the extra `encoders` is not installed")
    folder = tmp_path_factory.mktemp("models")
    sizes = {"hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 2}
    torch.manual_seed(0)
    vit = transformers.ViTConfig(**sizes, intermediate_size=64, image_size=32, patch_size=8)
    transformers.ViTModel(vit).save_pretrained(folder / "dino")
    transformers.Dinov2Model(transformers.Dinov2Config(**sizes, image_size=28, patch_size=14)).save_pretrained(folder / "v2")
    third = transformers.DINOv3ViTConfig(**sizes, intermediate_size=64, image_size=32, patch_size=16, num_register_tokens=4)
    transformers.DINOv3ViTModel(third).save_pretrained(folder / "v3")
    return {"dino": folder / "dino", "dinov2": folder / "v2", "dinov3": folder / "v3"}


KINDS: dict[str, type[DinoConfig] | type[Dinov2Config]] = {"dino": DinoConfig, "dinov2": Dinov2Config, "dinov3": Dinov3Config}


@pytest.mark.parametrize("family", KINDS)
def test_real_models(models: dict[str, Path], family: str) -> None:
    folder, kind = str(models[family]), KINDS[family]
    image = torch.rand(2, 3, 45, 70)
    last, third, second = (kind(model=folder, layer=layer, stride=8).build() for layer in (-1, 3, 2))
    assert last(image).shape == (2, 32, 6, 9)
    assert last.identity == third.identity != second.identity
    assert torch.equal(last(image), third(image))
    assert not torch.allclose(last(image), second(image))
    torch.testing.assert_close(last(image[:1]), last(image)[:1], rtol=1e-4, atol=1e-4)
    norms = last(image).std(dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms), rtol=0.1, atol=0.1)  # tokens pass the final norm
    with pytest.raises(WeightsError, match="allowed are 1 to 3"):
        kind(model=folder, layer=4).build()


@pytest.mark.parametrize("family", KINDS)
def test_real_models_keep_to_the_contract(models: dict[str, Path], family: str) -> None:
    check_encoder(KINDS[family](model=str(models[family]), layer=-1))


@pytest.mark.parametrize(("family", "other"), [("dino", "dinov3"), ("dinov2", "dino"), ("dinov3", "dinov2")])
def test_a_model_of_another_family_is_told(models: dict[str, Path], family: str, other: str) -> None:
    with pytest.raises(WeightsError, match=rf"{family}: .* cannot be loaded \(it is of type \w+, not "):
        KINDS[family](model=str(models[other])).build()
