"""DINOv2-small as it ships, against transformers on the same weights; DINO, DINOv2 and DINOv3 on small random
models.
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fprf.errors import ConfigError, WeightsError
from fprf.plugins.codec import from_json
from fprf.plugins.encoders.config import DinoConfig, Dinov2Config, Dinov3Config, EncoderConfig
from fprf.plugins.encoders.dinov2 import WEIGHTS, dequantised, load_dinov2
from fprf.plugins.encoders.vit import VitEncoder
from fprf.plugins.weights import IMAGENET_MEAN, IMAGENET_STD, read_weights, write_weights
from fprf.splats.config import GaussianSemanticsConfig
from fprf.testing import check_encoder


def picture(height: int, width: int) -> Tensor:
    """Smooth waves of colour and a disc [1 3 H W]."""
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    waves = torch.stack([torch.sin(9 * x), torch.sin(7 * y), torch.cos(5 * (x + y))]) / 2 + 0.5
    return torch.where((x - 0.6) ** 2 + (y - 0.4) ** 2 < 0.05, 1 - waves, waves)[None]


STORED = {
    (9, "tokens"): [-0.0036, 0.1948, 0.0312, -0.1223, -0.5577],
    (11, "keys"): [-0.0142, 1.0656, -1.4263, -0.4231, 1.0495],
}
"""Mean, deviation and some values, as transformers 5.23 gave them."""


@pytest.mark.parametrize(("layer", "kind"), STORED)
def test_features_are_those_stored(layer: int, kind: str) -> None:
    features = Dinov2Config(layer=layer, features=kind, stride=14).build()(picture(126, 168))[0]
    found = torch.stack(
        [features.mean(), features.std(), features[7, 0, 0], features[100, 4, 5], features[383, 8, 11]]
    )
    torch.testing.assert_close(found, torch.tensor(STORED[layer, kind]), rtol=1e-3, atol=1e-3)


def test_features_are_those_of_transformers(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers", reason="the extra `encoders` is not installed")
    sizes = {
        "hidden_size": 384,
        "num_hidden_layers": 11,
        "num_attention_heads": 6,
        "image_size": 518,
        "patch_size": 14,
    }
    transformers.Dinov2Config(**sizes).save_pretrained(tmp_path)
    tensors = _renamed(dequantised(read_weights(WEIGHTS)[0]))
    write_weights(tmp_path / "model.safetensors", tensors, {"format": "pt"})
    model = transformers.Dinov2Model.from_pretrained(tmp_path)
    key = next(
        each for name, each in model.named_modules() if ".10." in name and name.endswith((".k_proj", ".key"))
    )
    keys: list[Tensor] = []
    key.register_forward_hook(lambda *call: keys.append(call[-1]))
    image = picture(70, 98)  # five by seven patches
    normal = (image - torch.tensor(IMAGENET_MEAN).view(3, 1, 1)) / torch.tensor(IMAGENET_STD).view(3, 1, 1)
    with torch.no_grad():
        tokens = model(pixel_values=normal, output_hidden_states=True).hidden_states
    for layer in (1, 9, 11):
        ours = Dinov2Config(layer=layer, stride=14).build()(image)
        torch.testing.assert_close(ours.flatten(2).mT, tokens[layer][:, 1:], rtol=1e-4, atol=1e-4)
    ours = Dinov2Config(layer=11, features="keys", stride=14).build()(image)
    torch.testing.assert_close(ours.flatten(2).mT, keys[0][:, 1:], rtol=1e-4, atol=1e-4)


def _renamed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Under the names of checkpoints of the hub. The class token holds its position, which is then 0
    there.
    """
    theirs = {
        "embeddings.cls_token": tensors["cls_token"].view(1, 1, -1),
        "embeddings.mask_token": torch.zeros(1, 384),
        "layernorm.weight": torch.ones(384),
        "layernorm.bias": torch.zeros(384),
        "embeddings.position_embeddings": torch.cat(
            [torch.zeros(1, 1, 384), tensors["pos_embed"].flatten(1).T[None]], 1
        ),
    }
    names = {
        "patch_embed": "embeddings.patch_embeddings.projection",
        "blocks": "encoder.layer",
        "proj": "attention.output.dense",
        "fc1": "mlp.fc1",
        "fc2": "mlp.fc2",
    }
    for name, value in tensors.items():
        head, *path = name.split(".")
        if head in ("cls_token", "pos_embed"):
            continue
        if "qkv" in path:
            start = f"encoder.layer.{path[0]}.attention.attention"
            for part, rows in zip(("query", "key", "value"), value.chunk(3), strict=True):
                theirs[f"{start}.{part}.{path[-1]}"] = rows
        elif path[-1].startswith("scale"):
            theirs[f"encoder.layer.{path[0]}.layer_scale{path[-1][-1]}.lambda1"] = value
        else:
            theirs[".".join(names.get(word, word) for word in (head, *path))] = value
    return theirs


@pytest.mark.parametrize(("size", "cells"), [((96, 128), (16, 22)), ((40, 10), (22, 6)), ((3, 300), (1, 22))])
def test_without_a_stride_the_longer_side_has_22_cells(size: tuple[int, int], cells: tuple[int, int]) -> None:
    assert Dinov2Config(layer=1).build()(torch.rand(1, 3, *size)).shape[2:] == cells


@pytest.mark.parametrize("kind", ["tokens", "keys"])
def test_patches_that_show_nothing_are_as_if_masked_in_attention(kind: str) -> None:
    """The oracle attends from all patches to those shown, in float64."""
    network = load_dinov2(layer=3, kind=kind, stride=14).network.double()
    image = picture(70, 98).double()
    shown = torch.rand(5, 7, generator=torch.Generator().manual_seed(0)) < 0.4
    attention = F.scaled_dot_product_attention
    visible = torch.cat([torch.ones(1, dtype=torch.bool), shown.flatten()])
    with pytest.MonkeyPatch.context() as patch, torch.no_grad():
        patch.setattr(
            F, "scaled_dot_product_attention", lambda q, k, v: attention(q, k, v, attn_mask=visible[None])
        )
        masked = network(image, kind == "keys")
        patch.undo()
        found = network(image, kind == "keys", shown)
        plain = network(image, kind == "keys")
    torch.testing.assert_close(found[:, :, shown], masked[:, :, shown])
    assert (plain - masked)[:, :, shown].abs().max() > 0.01
    for row, column in (~shown).nonzero().tolist():
        away = (shown.nonzero() - torch.tensor([row, column])).double().norm(dim=1)
        nearest = shown.nonzero()[away == away.min()]
        assert any(torch.equal(found[..., row, column], found[..., y, x]) for y, x in nearest.tolist())


def test_what_is_cut_out_is_encoded_alone() -> None:
    """Each image of a batch as many patches as it shows; nothing shown, and all of it, are as images on
    grey.
    """
    encoder = Dinov2Config(layer=2, stride=14).build()
    opacity = torch.zeros(4, 70, 98)
    opacity[0, 14:42, 28:70] = 1
    opacity[1, :, :14] = 0.5
    opacity[2] = 1
    image = picture(70, 98) * opacity[:, None]
    found = encoder.cutout(image, opacity)
    on_grey = image + 0.5 * (1 - opacity[:, None])
    torch.testing.assert_close(found[2:], encoder(on_grey[2:]))
    for index, (rows, columns) in enumerate([(slice(1, 3), slice(2, 5)), (slice(0, 5), slice(0, 1))]):
        shown = torch.zeros(5, 7, dtype=torch.bool)
        shown[rows, columns] = True
        normal = (on_grey[index, None] - torch.tensor(IMAGENET_MEAN).view(3, 1, 1)) / torch.tensor(
            IMAGENET_STD
        ).view(3, 1, 1)
        with torch.no_grad():
            torch.testing.assert_close(found[index, None], encoder.network(normal, False, shown))


def test_blocks_count_from_either_end_and_those_that_do_not_ship_are_refused() -> None:
    assert Dinov2Config(layer=-4).build().identity == Dinov2Config(layer=9).build().identity
    for layer in (12, -1, -13):
        with pytest.raises(WeightsError, match="1 to 11"):
            Dinov2Config(layer=layer).build()
    with pytest.raises(ConfigError, match="keys"):
        Dinov2Config(model="facebook/dinov2-base", features="keys")


def test_a_run_that_named_the_model_of_the_hub_keeps_it() -> None:
    """As versions before the one that ships wrote it."""
    written = {"type": "dinov2", "model": "facebook/dinov2-small", "layer": -1, "stride": 8}
    kept = from_json({"encoder": written}, GaussianSemanticsConfig).encoder
    assert kept == Dinov2Config(model="facebook/dinov2-small", layer=-1, stride=8)


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
    mean = torch.tensor([0.485, 0.456, 0.406])
    std = torch.tensor([0.229, 0.224, 0.225])
    expected = (nn.functional.avg_pool2d(image, 4) - mean.view(1, 3, 1, 1)) / std.view(1, 3, 1, 1)
    torch.testing.assert_close(stand_in(4)(image), expected)


@pytest.mark.parametrize(
    "config", [DinoConfig(), Dinov2Config(model="facebook/dinov2-small"), Dinov3Config()]
)
def test_without_transformers_one_line_says_what_to_do(
    config: EncoderConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    transformers.Dinov2Model(
        transformers.Dinov2Config(**sizes, image_size=28, patch_size=14)
    ).save_pretrained(folder / "v2")
    third = transformers.DINOv3ViTConfig(
        **sizes, intermediate_size=64, image_size=32, patch_size=16, num_register_tokens=4
    )
    transformers.DINOv3ViTModel(third).save_pretrained(folder / "v3")
    return {"dino": folder / "dino", "dinov2": folder / "v2", "dinov3": folder / "v3"}


KINDS: dict[str, type[DinoConfig] | type[Dinov2Config]] = {
    "dino": DinoConfig,
    "dinov2": Dinov2Config,
    "dinov3": Dinov3Config,
}


@pytest.mark.parametrize("family", KINDS)
def test_real_models(models: dict[str, Path], family: str) -> None:
    folder = str(models[family])
    kind = KINDS[family]
    image = torch.rand(2, 3, 45, 70)
    last, third, second = (kind(model=folder, layer=layer, stride=8).build() for layer in (-1, 3, 2))
    assert last(image).shape == (2, 32, 6, 9)
    assert last.identity == third.identity != second.identity
    assert torch.equal(last(image), third(image))
    assert not torch.allclose(last(image), second(image))
    torch.testing.assert_close(last(image[:1]), last(image)[:1], rtol=1e-4, atol=1e-4)
    norms = last(image).std(dim=1)
    torch.testing.assert_close(
        norms, torch.ones_like(norms), rtol=0.1, atol=0.1
    )  # tokens pass the final norm
    with pytest.raises(WeightsError, match="allowed are 1 to 3"):
        kind(model=folder, layer=4).build()


@pytest.mark.parametrize("family", KINDS)
def test_real_models_keep_to_the_contract(models: dict[str, Path], family: str) -> None:
    check_encoder(KINDS[family](model=str(models[family]), layer=-1))


@pytest.mark.parametrize(("family", "other"), [("dino", "dinov3"), ("dinov2", "dino"), ("dinov3", "dinov2")])
def test_a_model_of_another_family_is_told(models: dict[str, Path], family: str, other: str) -> None:
    with pytest.raises(WeightsError, match=rf"{family}: .* cannot be loaded \(it is of type \w+, not "):
        KINDS[family](model=str(models[other])).build()
