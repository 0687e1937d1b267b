"""ESPNetv2 (Mehta et al.): the levels of its base network, from the tensors of EdgeNets' files, at any width.

How often a block repeats is read off the names. Convolutions of stride 2 are padded on both sides, which puts cells half
a cell to the left of and above what they stand for; the filters have learned to make up for half of that. The rest is
made up for here: with the image a quarter cell further on, features of mirrored photographs agree at 0.79 instead of
0.69 (cosine; cities, level 4). The decoder makes up for all of it by itself.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..weights import WeightSource, find_weights, input_statistics, read_tensors
from .frozen import FrozenTensors, NetworkEncoder, fitting


def convolve(
    tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str, *, stride: int = 1, dilation: int = 1
) -> Annotated[Tensor, "B G h w"]:
    """Zero-padded so that stride 1 keeps the size; with a bias where the file has one."""
    weight = tensors[f"{name}.weight"]
    bias = tensors.get(f"{name}.bias")
    padding = weight.shape[-1] // 2 * dilation
    return F.conv2d(x, weight, bias, stride, padding, dilation, x.shape[1] // weight.shape[1])


def norm(tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str) -> Annotated[Tensor, "B F H W"]:
    """Batch normalisation by the statistics of training."""
    mean, variance, weight, bias = (tensors[f"{name}.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
    return F.batch_norm(x, mean, variance, weight, bias)


def prelu(tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str) -> Annotated[Tensor, "B F H W"]:
    """A slope of its own for the negative part of every channel."""
    return F.prelu(x, tensors[f"{name}.weight"])


def normed_activation(
    tensors: FrozenTensors, x: Annotated[Tensor, "B F H W"], name: str, parts: tuple[str, str] = ("bn", "act")
) -> Annotated[Tensor, "B F H W"]:
    """Normalisation, then activation; the decoder numbers them where the base network names them."""
    return prelu(tensors, norm(tensors, x, f"{name}.{parts[0]}"), f"{name}.{parts[1]}")


SCALES = (2.0, 1.5, 1.0, 0.5, 0.1)
SMALLEST = 5
"""Cells along an axis that a pyramid's coarse copies keep at least."""


def class_scores(tensors: FrozenTensors, levels: Sequence[Tensor]) -> Tensor:
    """From the maps [B F h w] of the four levels, finest first, to [B K h w] at the size of the first."""
    x = _pyramid_pool(tensors, levels[-1], "bu_dec_l1")
    x = normed_activation(tensors, x, "bu_dec_l1.br.br", ("0", "1"))
    for step, level in zip((2, 3, 4), reversed(levels[:-1]), strict=True):
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True) + _merged(tensors, level, step)
        x = _pyramid_pool(tensors, normed_activation(tensors, x, f"bu_br_l{step}", ("0", "1")), f"bu_dec_l{step}")
        if step < len(levels):
            x = normed_activation(tensors, x, f"bu_dec_l{step}.br.br", ("0", "1"))
    return x


def _merged(tensors: FrozenTensors, level: Tensor, step: int) -> Tensor:
    """A level of the base network, its channels weighed by what the whole image holds."""
    name = f"merge_enc_dec_l{step}"
    shares = torch.sigmoid(convolve(tensors, level.mean(dim=(2, 3), keepdim=True), f"{name}.wt_layer.1"))
    return shares * _convolved(tensors, level, f"{name}.expansion_layer.cbr")


def _pyramid_pool(tensors: FrozenTensors, x: Tensor, name: str) -> Tensor:
    """One depthwise convolution at each of several sizes, merged channel by channel."""
    x = _convolved(tensors, x, f"{name}.projection_layer.cbr")
    size = (x.shape[2], x.shape[3])
    levels = []
    for index, scale in enumerate(SCALES):
        scaled = (max(SMALLEST, math.ceil(size[0] * scale)), max(SMALLEST, math.ceil(size[1] * scale)))
        stage = f"{name}.stages.{index}"
        if scale > 1:
            larger = F.interpolate(x, scaled, mode="bilinear", align_corners=True)
            levels.append(F.adaptive_avg_pool2d(convolve(tensors, larger, stage), size))
        elif scale < 1:
            smaller = convolve(tensors, F.adaptive_avg_pool2d(x, scaled), stage)
            levels.append(F.interpolate(smaller, size, mode="bilinear", align_corners=True))
        else:
            levels.append(convolve(tensors, x, stage))
    joined = normed_activation(tensors, torch.cat(levels, dim=1), f"{name}.merge_layer.0.br", ("0", "1"))
    # Channel by channel, all sizes of it together: what the grouped convolution after it takes.
    batch, channels = joined.shape[:2]
    joined = joined.view(batch, len(SCALES), channels // len(SCALES), *size).transpose(1, 2).flatten(1, 2)
    return convolve(tensors, _convolved(tensors, joined, f"{name}.merge_layer.2.cbr"), f"{name}.merge_layer.3")


def _convolved(tensors: FrozenTensors, x: Tensor, name: str) -> Tensor:
    return normed_activation(tensors, convolve(tensors, x, f"{name}.0"), name, ("1", "2"))


FLAG = "--semantic.encoder.weights"
SOURCE = WeightSource(
    "ESPNetv2",
    "espnetv2_s_2.0_pascal_384x384.pth",
    "in github.com/sacmehta/EdgeNets, model/segmentation/model_zoo/espnetv2, beside the one for cities",
    FLAG,
)
LEVELS = ("level1", "level2", "level3", "level4")
STRIDES: Mapping[str, int] = {"level1": 2, "level2": 4, "level3": 8, "level4": 16, "logits": 2}
COARSEST = 16
LATE = 4
"""Cells look that part of a cell too far to the left and up."""
WIDE, NARROW = (1, 2, 3, 4), (1, 1, 2, 3)
"""Dilations of a block's four branches; the narrow ones belong to the blocks of level 4."""


class EspNet(nn.Module):
    """The base network up to a level, or the whole one for `logits`. Takes multiples of the level's stride, 16 for logits."""

    def __init__(
        self, tensors: Mapping[str, Tensor], layer: str, *, mean: Annotated[Tensor, "3"], std: Annotated[Tensor, "3"]
    ) -> None:
        super().__init__()
        self._layer = layer
        self._late = 0 if layer == "logits" else STRIDES[layer] // LATE
        self._levels = LEVELS[: LEVELS.index(layer) + 1] if layer in LEVELS else LEVELS
        needed = [f"base_net.{level}" for level in self._levels]
        used = {
            name: value
            for name, value in tensors.items()
            if (layer == "logits" or any(name.startswith(start) for start in needed)) and not name.endswith("batches_tracked")
        }
        self.tensors = FrozenTensors(used)
        self.register_buffer("mean", mean.view(3, 1, 1))
        self.register_buffer("std", std.view(3, 1, 1))

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B F h w"]:
        """Features of sRGB images in [0, 1], a cell per stride; for `logits` one score a class, before the softmax."""
        image = (image - self.get_buffer("mean")) / self.get_buffer("std")
        margin = STRIDES[self._layer] - self._late if self._late else 0
        image = F.pad(image, (margin, self._late, margin, self._late), mode="replicate")
        x = normed_activation(self.tensors, convolve(self.tensors, image, "base_net.level1.conv", stride=2), "base_net.level1")
        reached = [x]
        for level in self._levels[1:]:
            x = self._reduced(x, image, f"base_net.{level}_0")
            dilations, block = NARROW if level == "level4" else WIDE, 0
            while f"base_net.{level}.{block}.module_act.weight" in self.tensors:
                name = f"base_net.{level}.{block}"
                x = prelu(self.tensors, x + self._pyramid(x, name, dilations), f"{name}.module_act")
                block += 1
            reached.append(x)
        if self._layer == "logits":
            return class_scores(self.tensors, reached)
        return x[:, :, 1:, 1:] if self._late else x

    def _reduced(self, x: Tensor, image: Tensor, name: str) -> Tensor:
        """Half the size: means and strided pyramid side by side, and the image itself, pooled as far, added."""
        pooled = _halved(x)
        joined = torch.cat([pooled, self._pyramid(x, f"{name}.eesp", WIDE, stride=2)], dim=1)
        while image.shape[-2] > pooled.shape[-2] or image.shape[-1] > pooled.shape[-1]:
            image = _halved(image)
        shortcut = convolve(self.tensors, image, f"{name}.inp_reinf.0.conv")
        shortcut = convolve(
            self.tensors, normed_activation(self.tensors, shortcut, f"{name}.inp_reinf.0"), f"{name}.inp_reinf.1.conv"
        )
        return prelu(self.tensors, joined + norm(self.tensors, shortcut, f"{name}.inp_reinf.1.bn"), f"{name}.act")

    def _pyramid(self, x: Tensor, name: str, dilations: tuple[int, ...], stride: int = 1) -> Tensor:
        """Reduce, convolve with growing holes, add each branch to the next one, expand."""
        reduced = normed_activation(self.tensors, convolve(self.tensors, x, f"{name}.proj_1x1.conv"), f"{name}.proj_1x1")
        branches: list[Tensor] = []
        for index, dilation in enumerate(dilations):
            level = convolve(self.tensors, reduced, f"{name}.spp_dw.{index}.conv", stride=stride, dilation=dilation)
            branches.append(level + branches[-1] if branches else level)
        joined = normed_activation(self.tensors, torch.cat(branches, dim=1), f"{name}.br_after_cat")
        return norm(self.tensors, convolve(self.tensors, joined, f"{name}.conv_1x1_exp.conv"), f"{name}.conv_1x1_exp.bn")


def build_espnet(layer: str, *, weights: Path | None) -> NetworkEncoder:
    """`level1` to `level4`, or `logits`. Raises WeightsError where the file is absent or does not hold the layer."""
    path = find_weights(SOURCE, weights)
    tensors, metadata = read_tensors(path, SOURCE)
    mean, std = input_statistics(metadata, path)
    with fitting(str(path), f"ESPNetv2 {layer}", FLAG):
        network = EspNet(tensors, layer, mean=mean, std=std)
        multiple = COARSEST if layer == "logits" else STRIDES[layer]
        return NetworkEncoder(f"espnet:{layer}", network, stride=multiple)


def _halved(x: Tensor) -> Tensor:
    return F.avg_pool2d(x, 3, stride=2, padding=1)
