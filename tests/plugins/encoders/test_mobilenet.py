"""MobileNetV2 and DeepLab layer by layer in float64: norms folded, both ways of padding, dilations, cells in their places."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from network_files import CLASSES, deeplab_file, deeplab_tensors, mobilenet_file, mobilenet_tensors
from safetensors.torch import save_file
from torch import Tensor

from fprf.errors import WeightsError
from fprf.plugins.encoders.config import DeepLabConfig, MobileNetV2Config

STRIDES = (1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1)
IMAGENET = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], dtype=torch.float64).view(2, 3, 1, 1)


def blocks(x: Tensor, values: dict[str, Tensor], start: str, last: int, *, same: bool, eps: float | None) -> Tensor:
    """torchvision's modules one after the other, batch normalisation as such; DeepLab's (no eps) keep stride 16 and dilate."""

    def layer(x: Tensor, conv: str, norm: str, stride: int = 1, groups: int = 1, dilation: int = 1) -> Tensor:
        weight = values[f"{start}.{conv}.weight"]
        if weight.shape[-1] == 3:
            tight = same and stride == 2 and x.shape[-1] % 2 == 0
            x = F.pad(x, (0, 1, 0, 1) if tight else (dilation,) * 4)
        x = F.conv2d(x, weight, values.get(f"{start}.{conv}.bias"), stride, groups=groups, dilation=dilation)
        if eps is None:
            return x
        mean, variance, gain, bias = (
            values[f"{start}.{norm}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")
        )
        return F.batch_norm(x, mean, variance, gain, bias, eps=eps)

    x = layer(x, "0.0", "0.1", 2).clamp(0, 6)
    for block in range(1, min(last, 17) + 1):
        coarse = eps is None and block >= 14
        stride, dilation = 1 if coarse else STRIDES[block - 1], 2 if eps is None and block >= 15 else 1
        y, at = x, 0
        if block > 1:
            y, at = layer(x, f"{block}.conv.0.0", f"{block}.conv.0.1").clamp(0, 6), 1
        y = layer(y, f"{block}.conv.{at}.0", f"{block}.conv.{at}.1", stride, y.shape[1], dilation).clamp(0, 6)
        y = layer(y, f"{block}.conv.{at + 1}", f"{block}.conv.{at + 2}")
        x = x + y if stride == 1 and x.shape == y.shape else y
    return layer(x, "18.0", "18.1").clamp(0, 6) if last == 18 else x


def doubled(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.double() for name, value in tensors.items()}


@pytest.mark.parametrize("tensorflow", [True, False])
@pytest.mark.parametrize("last", [0, 6, 18])
def test_mobilenet_layer_by_layer(tmp_path: Path, tensorflow: bool, last: int) -> None:
    encoder = MobileNetV2Config(layer=f"features.{last}", weights=mobilenet_file(tmp_path, tensorflow=tensorflow)).build()
    image = torch.rand(2, 3, 64, 96)
    x = 2 * image.double() - 1 if tensorflow else (image.double() - IMAGENET[0]) / IMAGENET[1]
    values, eps = doubled(mobilenet_tensors(folded=False)), 1e-3 if tensorflow else 1e-5
    expected = blocks(x, values, "features", last, same=tensorflow, eps=eps)
    found = encoder(image)
    assert encoder.channels == found.shape[1] == expected.shape[1]
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("last", "stride"), [(1, 2), (6, 8), (17, 16)])
def test_deeplab_layer_by_layer(tmp_path: Path, last: int, stride: int) -> None:
    """On the odd size that it was trained for: half a cell before the image, half a cell and a pixel after."""
    encoder = DeepLabConfig(layer=f"backbone.{last}", weights=deeplab_file(tmp_path)).build()
    image = torch.rand(1, 3, 48, 64)
    half = stride // 2
    x = F.pad(2 * image.double() - 1, (half, half + 1, half, half + 1), mode="replicate")
    expected = blocks(x, doubled(deeplab_tensors()), "backbone", last, same=True, eps=None)[..., 1:-1, 1:-1]
    assert expected.shape[-2:] == (48 // stride, 64 // stride)
    torch.testing.assert_close(encoder(image).double(), expected, rtol=1e-4, atol=1e-4)


def test_deeplabs_scores(tmp_path: Path) -> None:
    file, values = deeplab_file(tmp_path), doubled(deeplab_tensors())
    image = torch.rand(2, 3, 48, 64)
    x = DeepLabConfig(weights=file).build()(image).double()

    def dense(cells: Tensor, name: str) -> Tensor:
        """Channels of cells [B h w C]."""
        return cells @ values[f"head.{name}.weight"][:, :, 0, 0].T + values[f"head.{name}.bias"]

    cells = x.permute(0, 2, 3, 1)
    whole = dense(cells.mean((1, 2)), "image_pooling").relu()[:, None, None].expand(-1, 3, 4, -1)
    joined = torch.cat([whole, dense(cells, "aspp0").relu()], dim=-1)
    expected = dense(dense(joined, "concat_projection").relu(), "logits").permute(0, 3, 1, 2)
    encoder = DeepLabConfig(layer="logits", weights=file).build()
    assert encoder.channels == CLASSES
    torch.testing.assert_close(encoder(image).double(), expected, rtol=1e-4, atol=1e-4)


def test_files_that_do_not_fit(tmp_path: Path) -> None:
    tensors = mobilenet_tensors(folded=False)
    short = {name: value for name, value in tensors.items() if not name.startswith("features.14")}
    save_file(short, tmp_path / "short.safetensors")
    assert MobileNetV2Config(weights=tmp_path / "short.safetensors").build().channels == 4
    with pytest.raises(WeightsError, match=r"does not hold MobileNetV2 features\.14 \(14\.conv.*is missing.*--semantic\.enc"):
        MobileNetV2Config(layer="features.14", weights=tmp_path / "short.safetensors").build()
    save_file(tensors, tmp_path / "eps.safetensors", {"bn_eps": "small"})
    with pytest.raises(WeightsError, match="bn_eps' is 'small'"):
        MobileNetV2Config(weights=tmp_path / "eps.safetensors").build()
    with pytest.raises(WeightsError, match=r"does not hold DeepLabv3 backbone\.17"):
        DeepLabConfig(weights=tmp_path / "short.safetensors").build()
    tensors["features.3.conv.0.0.weight"] = torch.zeros(8, 9, 1, 1)
    save_file(tensors, tmp_path / "wide.safetensors")
    with pytest.raises(WeightsError, match=r"does not hold MobileNetV2 features\.13"):
        MobileNetV2Config(weights=tmp_path / "wide.safetensors").build()
    backbone = {name: value for name, value in deeplab_tensors().items() if name.startswith("backbone")}
    save_file(backbone, tmp_path / "headless.safetensors")
    with pytest.raises(WeightsError, match=r"DeepLabv3 logits \(image_pooling\.weight is missing"):
        DeepLabConfig(layer="logits", weights=tmp_path / "headless.safetensors").build()
