"""DINOv2-small as it ships: its features are those of transformers' Dinov2Model on the same weights."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.errors import ConfigError, WeightsError
from fprf.plugins.codec import from_json
from fprf.plugins.encoders.config import Dinov2Config
from fprf.plugins.encoders.dinov2 import WEIGHTS, dequantised, load_dinov2
from fprf.plugins.weights import IMAGENET_MEAN, IMAGENET_STD, read_weights, write_weights
from fprf.splats.config import GaussianSemanticsConfig


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
    found = torch.stack([features.mean(), features.std(), features[7, 0, 0], features[100, 4, 5], features[383, 8, 11]])
    torch.testing.assert_close(found, torch.tensor(STORED[layer, kind]), rtol=1e-3, atol=1e-3)


def test_features_are_those_of_transformers(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers", reason="the extra `encoders` is not installed")
    sizes = {"hidden_size": 384, "num_hidden_layers": 11, "num_attention_heads": 6, "image_size": 518, "patch_size": 14}
    transformers.Dinov2Config(**sizes).save_pretrained(tmp_path)
    tensors = _renamed(dequantised(read_weights(WEIGHTS)[0]))
    write_weights(tmp_path / "model.safetensors", tensors, {"format": "pt"})
    model = transformers.Dinov2Model.from_pretrained(tmp_path)
    key = next(each for name, each in model.named_modules() if ".10." in name and name.endswith((".k_proj", ".key")))
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
    """Under the names of checkpoints of the hub. The class token holds its position, which is then 0 there."""
    theirs = {
        "embeddings.cls_token": tensors["cls_token"].view(1, 1, -1),
        "embeddings.mask_token": torch.zeros(1, 384),
        "layernorm.weight": torch.ones(384),
        "layernorm.bias": torch.zeros(384),
        "embeddings.position_embeddings": torch.cat([torch.zeros(1, 1, 384), tensors["pos_embed"].flatten(1).T[None]], 1),
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
        patch.setattr(F, "scaled_dot_product_attention", lambda q, k, v: attention(q, k, v, attn_mask=visible[None]))
        masked = network(image, kind == "keys")
        patch.undo()
        found, plain = network(image, kind == "keys", shown), network(image, kind == "keys")
    torch.testing.assert_close(found[:, :, shown], masked[:, :, shown])
    assert (plain - masked)[:, :, shown].abs().max() > 0.01
    for row, column in (~shown).nonzero().tolist():
        away = (shown.nonzero() - torch.tensor([row, column])).double().norm(dim=1)
        nearest = shown.nonzero()[away == away.min()]
        assert any(torch.equal(found[..., row, column], found[..., y, x]) for y, x in nearest.tolist())


def test_what_is_cut_out_is_encoded_alone() -> None:
    """Each image of a batch as many patches as it shows; nothing shown, and all of it, are as images on grey."""
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
        normal = (on_grey[index, None] - torch.tensor(IMAGENET_MEAN).view(3, 1, 1)) / torch.tensor(IMAGENET_STD).view(3, 1, 1)
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
