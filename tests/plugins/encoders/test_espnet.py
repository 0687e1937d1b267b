"""ESPNetv2 against modules put together from its description, in float64; its labels of a real street."""

import math
from pathlib import Path

import cv2
import pytest
import torch
import torch.nn.functional as F
from network_files import CLASSES, espnet_file, espnet_tensors
from torch import Tensor

from fprf.plugins.encoders.config import EspNetConfig

STRIDES = {"level1": 2, "level2": 4, "level3": 8, "level4": 16}
MEAN, STD = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])


class Oracle:
    """Channel by channel where convolutions are grouped; no branch shares its sums with another."""

    def __init__(self, tensors: dict[str, Tensor]) -> None:
        self.values = {name: value.double() for name, value in tensors.items()}

    def conv(self, x: Tensor, name: str, stride: int = 1, dilation: int = 1) -> Tensor:
        weight = self.values[f"{name}.weight"]
        groups, reach = x.shape[1] // weight.shape[1], weight.shape[2] // 2 * dilation
        outputs = len(weight) // groups
        parts = [
            F.conv2d(F.pad(some, (reach,) * 4), weight[g * outputs : (g + 1) * outputs], stride=stride, dilation=dilation)
            for g, some in enumerate(x.chunk(groups, dim=1))
        ]
        bias = self.values.get(f"{name}.bias", torch.zeros(len(weight)).double())
        return torch.cat(parts, dim=1) + bias.view(-1, 1, 1)

    def norm(self, x: Tensor, name: str) -> Tensor:
        mean, variance, gain, bias = (
            self.values[f"{name}.{part}"].view(-1, 1, 1) for part in ("running_mean", "running_var", "weight", "bias")
        )
        return (x - mean) / (variance + 1e-5).sqrt() * gain + bias

    def prelu(self, x: Tensor, name: str) -> Tensor:
        return torch.where(x > 0, x, x * self.values[f"{name}.weight"].view(-1, 1, 1))

    def pyramid(self, x: Tensor, name: str, dilations: tuple[int, ...], stride: int = 1) -> Tensor:
        x = self.prelu(self.norm(self.conv(x, f"{name}.proj_1x1.conv"), f"{name}.proj_1x1.bn"), f"{name}.proj_1x1.act")
        alone = [self.conv(x, f"{name}.spp_dw.{k}.conv", stride, dilation) for k, dilation in enumerate(dilations)]
        summed = torch.cat([torch.stack(alone[: k + 1]).sum(0) for k in range(4)], dim=1)
        joined = self.prelu(self.norm(summed, f"{name}.br_after_cat.bn"), f"{name}.br_after_cat.act")
        return self.norm(self.conv(joined, f"{name}.conv_1x1_exp.conv"), f"{name}.conv_1x1_exp.bn")

    def levels(self, image: Tensor, last: int = 4) -> list[Tensor]:
        image = (image.double() - MEAN.view(3, 1, 1)) / STD.view(3, 1, 1)
        x = self.conv(image, "base_net.level1.conv", 2)
        found = [self.prelu(self.norm(x, "base_net.level1.bn"), "base_net.level1.act")]
        for level, blocks in ((2, 0), (3, 2), (4, 3))[: last - 1]:
            name, x = f"base_net.level{level}_0", found[-1]
            small = image
            for _ in range(level):
                small = F.avg_pool2d(small, 3, 2, 1)
            small = self.prelu(
                self.norm(self.conv(small, f"{name}.inp_reinf.0.conv"), f"{name}.inp_reinf.0.bn"), f"{name}.inp_reinf.0.act"
            )
            small = self.norm(self.conv(small, f"{name}.inp_reinf.1.conv"), f"{name}.inp_reinf.1.bn")
            x = torch.cat([F.avg_pool2d(x, 3, 2, 1), self.pyramid(x, f"{name}.eesp", (1, 2, 3, 4), 2)], dim=1)
            x = self.prelu(x + small, f"{name}.act")
            for block in range(blocks):
                dilations = (1, 1, 2, 3) if level == 4 else (1, 2, 3, 4)
                y = x + self.pyramid(x, f"base_net.level{level}.{block}", dilations)
                x = self.prelu(y, f"base_net.level{level}.{block}.module_act")
            found.append(x)
        return found

    def pooled(self, x: Tensor, name: str) -> Tensor:
        x = self.conv(x, f"{name}.projection_layer.cbr.0")
        x = self.prelu(self.norm(x, f"{name}.projection_layer.cbr.1"), f"{name}.projection_layer.cbr.2")
        size, found = list(x.shape[2:]), []
        for k, scale in enumerate((2.0, 1.5, 1.0, 0.5, 0.1)):
            other = [max(5, math.ceil(n * scale)) for n in size]
            if scale > 1:
                y = self.conv(F.interpolate(x, other, mode="bilinear", align_corners=True), f"{name}.stages.{k}")
                y = F.adaptive_avg_pool2d(y, size)
            elif scale < 1:
                y = self.conv(F.adaptive_avg_pool2d(x, other), f"{name}.stages.{k}")
                y = F.interpolate(y, size, mode="bilinear", align_corners=True)
            else:
                y = self.conv(x, f"{name}.stages.{k}")
            found.append(y)
        joined = torch.cat(found, dim=1)
        joined = self.prelu(self.norm(joined, f"{name}.merge_layer.0.br.0"), f"{name}.merge_layer.0.br.1")
        width = x.shape[1]
        order = [size * width + channel for channel in range(width) for size in range(5)]
        y = self.conv(joined[:, order], f"{name}.merge_layer.2.cbr.0")
        y = self.prelu(self.norm(y, f"{name}.merge_layer.2.cbr.1"), f"{name}.merge_layer.2.cbr.2")
        return self.conv(y, f"{name}.merge_layer.3")

    def scores(self, image: Tensor) -> Tensor:
        levels = self.levels(image)
        x = self.pooled(levels[3], "bu_dec_l1")
        for step in (1, 2, 3):
            x = self.prelu(self.norm(x, f"bu_dec_l{step}.br.br.0"), f"bu_dec_l{step}.br.br.1")
            x = F.interpolate(x, [2 * n for n in x.shape[2:]], mode="bilinear", align_corners=True)
            level, merge, after = levels[3 - step], f"merge_enc_dec_l{step + 1}", f"bu_br_l{step + 1}"
            share = self.conv(level.mean((2, 3), keepdim=True), f"{merge}.wt_layer.1").sigmoid()
            level = self.norm(self.conv(level, f"{merge}.expansion_layer.cbr.0"), f"{merge}.expansion_layer.cbr.1")
            x = x + share * self.prelu(level, f"{merge}.expansion_layer.cbr.2")
            x = self.pooled(self.prelu(self.norm(x, f"{after}.0"), f"{after}.1"), f"bu_dec_l{step + 1}")
        return x


@pytest.mark.parametrize("layer", list(STRIDES))
def test_levels(tmp_path: Path, layer: str) -> None:
    """A quarter of a cell further on than the plain network looks, and with the cell that this adds dropped."""
    encoder = EspNetConfig(layer=layer, weights=espnet_file(tmp_path)).build()
    image, stride = torch.rand(2, 3, 48, 80), STRIDES[layer]
    late = stride // 4
    before = stride - late if late else 0
    moved = F.pad(image, (before, late, before, late), mode="replicate")
    cells = slice(1 if late else 0, None)
    expected = Oracle(espnet_tensors()).levels(moved, int(layer[-1]))[-1][:, :, cells, cells]
    assert expected.shape == (2, encoder.channels, 48 // stride, 80 // stride)
    torch.testing.assert_close(encoder(image).double(), expected, rtol=1e-4, atol=1e-4)


def test_scores(tmp_path: Path) -> None:
    encoder = EspNetConfig(layer="logits", weights=espnet_file(tmp_path)).build()
    image = torch.rand(2, 3, 48, 80)
    assert encoder.channels == CLASSES
    torch.testing.assert_close(encoder(image).double(), Oracle(espnet_tensors()).scores(image), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_labels_of_a_street(shared: Path) -> None:
    """`labels_city` were made by the published network at another size."""
    from fprf.pretraining.photos import load_photo

    scene = shared / "data/scenes/street_lund"
    encoder = EspNetConfig(layer="logits", weights=shared / "weights/espnetv2_s2.0_city.safetensors").build()
    for name in ("04", "16"):
        image = load_photo(scene / f"images/{name}.jpg").permute(2, 0, 1)[None]
        scores = F.interpolate(encoder(image), image.shape[2:], mode="bilinear", align_corners=True)
        labels = torch.from_numpy(cv2.imread(str(scene / f"labels_city/{name}.png"), cv2.IMREAD_UNCHANGED))
        assert float((scores[0].argmax(0) == labels).float().mean()) > 0.8
