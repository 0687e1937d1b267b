"""Small files in the shape of MobileNetV2's, DeepLab's and ESPNetv2's, with random weights."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

GREY = {"mean": json.dumps([0.5] * 3), "std": json.dumps([0.5] * 3)}
TENSORFLOW = {**GREY, "padding": "TensorFlow SAME: as much after as before, or one more", "bn_eps": "0.001"}
CLASSES = 5


class Draw:
    """Random tensors under names, of the size that keeps activations O(1)."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.tensors: dict[str, Tensor] = {}

    def convolution(self, name: str, outputs: int, inputs: int, size: int, *, bias: bool = False) -> None:
        """`inputs` of each group."""
        scale = (1.5 / (inputs * size * size)) ** 0.5
        self.tensors[f"{name}.weight"] = scale * torch.randn(outputs, inputs, size, size, generator=self.generator)
        if bias:
            self.tensors[f"{name}.bias"] = 0.1 * torch.randn(outputs, generator=self.generator)

    def norm(self, name: str, channels: int) -> None:
        for part in ("weight", "running_var"):
            self.tensors[f"{name}.{part}"] = 0.5 + torch.rand(channels, generator=self.generator)
        for part in ("bias", "running_mean"):
            self.tensors[f"{name}.{part}"] = 0.1 * torch.randn(channels, generator=self.generator)
        self.tensors[f"{name}.num_batches_tracked"] = torch.tensor(7)

    def slopes(self, name: str, channels: int) -> None:
        self.tensors[f"{name}.weight"] = 0.1 + 0.3 * torch.rand(channels, generator=self.generator)


def mobilenet_tensors(*, folded: bool, width: int = 4) -> dict[str, Tensor]:
    """torchvision's names and norms, or DeepLab's backbone without."""
    draw, start = Draw(1), "backbone." if folded else "features."

    def put(place: str, number: int, outputs: int, inputs: int, size: int) -> None:
        draw.convolution(f"{start}{place}.{number}", outputs, inputs, size, bias=folded)
        if not folded:
            draw.norm(f"{start}{place}.{number + 1}", outputs)

    put("0", 0, width, 3, 3)
    for block in range(1, 18):
        at, wide = (1, 2 * width) if block > 1 else (0, width)
        if block > 1:
            put(f"{block}.conv.0", 0, wide, width, 1)
        put(f"{block}.conv.{at}", 0, wide, 1, 3)
        put(f"{block}.conv", at + 1, width, wide, 1)
    if not folded:
        put("18", 0, 3 * width, width, 1)
    return draw.tensors


def mobilenet_file(folder: Path, *, tensorflow: bool) -> Path:
    """With the metadata of Keras's weights, or none, as torchvision's."""
    path = folder / f"mobilenet-{tensorflow}.safetensors"
    save_file(mobilenet_tensors(folded=False), path, TENSORFLOW if tensorflow else {})
    return path


def deeplab_tensors(width: int = 4) -> dict[str, Tensor]:
    """Backbone and head, norms folded."""
    draw = Draw(2)
    draw.convolution("head.image_pooling", 6, width, 1, bias=True)
    draw.convolution("head.aspp0", 6, width, 1, bias=True)
    draw.convolution("head.concat_projection", 7, 12, 1, bias=True)
    draw.convolution("head.logits", CLASSES, 7, 1, bias=True)
    return mobilenet_tensors(folded=True, width=width) | draw.tensors


def deeplab_file(folder: Path) -> Path:
    """With its metadata."""
    save_file(deeplab_tensors(), folder / "deeplab.safetensors", GREY)
    return folder / "deeplab.safetensors"


def espnet_tensors() -> dict[str, Tensor]:
    """Levels of 16 to 128 channels, none, two and three blocks, and the decoder of so many classes."""
    draw, widths = Draw(3), (16, 32, 64, 128)

    def normed(name: str, channels: int, parts: tuple[str, str] = ("bn", "act")) -> None:
        draw.norm(f"{name}.{parts[0]}", channels)
        draw.slopes(f"{name}.{parts[1]}", channels)

    def pyramid(name: str, inputs: int, outputs: int) -> None:
        quarter = outputs // 4
        draw.convolution(f"{name}.proj_1x1.conv", quarter, inputs // 4, 1)
        normed(f"{name}.proj_1x1", quarter)
        for branch in range(4):
            draw.convolution(f"{name}.spp_dw.{branch}.conv", quarter, 1, 3)
        normed(f"{name}.br_after_cat", outputs)
        draw.convolution(f"{name}.conv_1x1_exp.conv", outputs, quarter, 1)
        draw.norm(f"{name}.conv_1x1_exp.bn", outputs)
        draw.slopes(f"{name}.module_act", outputs)

    draw.convolution("base_net.level1.conv", widths[0], 3, 3)
    normed("base_net.level1", widths[0])
    for level, blocks in ((2, 0), (3, 2), (4, 3)):
        name, inputs, outputs = f"base_net.level{level}", widths[level - 2], widths[level - 1]
        pyramid(f"{name}_0.eesp", inputs, outputs - inputs)
        draw.convolution(f"{name}_0.inp_reinf.0.conv", 3, 3, 3)
        normed(f"{name}_0.inp_reinf.0", 3)
        draw.convolution(f"{name}_0.inp_reinf.1.conv", outputs, 3, 1)
        draw.norm(f"{name}_0.inp_reinf.1.bn", outputs)
        draw.slopes(f"{name}_0.act", outputs)
        for block in range(blocks):
            pyramid(f"{name}.{block}", outputs, outputs)

    inputs, projected = widths[3], 2
    for step, outputs in ((1, 8), (2, 6), (3, 4), (4, CLASSES)):
        name = f"bu_dec_l{step}"
        draw.convolution(f"{name}.projection_layer.cbr.0", projected, inputs, 1)
        normed(f"{name}.projection_layer.cbr", projected, ("1", "2"))
        for stage in range(5):
            draw.convolution(f"{name}.stages.{stage}", projected, 1, 3)
        normed(f"{name}.merge_layer.0.br", 5 * projected, ("0", "1"))
        draw.convolution(f"{name}.merge_layer.2.cbr.0", projected, 5, 3)
        normed(f"{name}.merge_layer.2.cbr", projected, ("1", "2"))
        draw.convolution(f"{name}.merge_layer.3", outputs, projected, 1, bias=step == 4)
        if step < 4:
            normed(f"{name}.br.br", outputs, ("0", "1"))
            merge, level = f"merge_enc_dec_l{step + 1}", widths[3 - step]
            draw.convolution(f"{merge}.wt_layer.1", outputs, level, 1)
            draw.convolution(f"{merge}.expansion_layer.cbr.0", outputs, level // math.gcd(level, outputs), 3)
            normed(f"{merge}.expansion_layer.cbr", outputs, ("1", "2"))
            normed(f"bu_br_l{step + 1}", outputs, ("0", "1"))
        inputs = outputs
    return draw.tensors


def espnet_file(folder: Path) -> Path:
    """Without metadata, as a file of `torch.save` would be."""
    save_file(espnet_tensors(), folder / "espnet.safetensors")
    return folder / "espnet.safetensors"


LAYERS = {0: "1_1", 2: "1_2", 5: "2_1", 7: "2_2", 10: "3_1"}


def vgg_convolutions(widths: Mapping[int, int], *, seed: int = 3, biased: bool = True) -> dict[str, Tensor]:
    """Convolutions of so many filters at places of torchvision's `features`."""
    generator, tensors, inputs = torch.Generator().manual_seed(seed), {}, 3
    for place, outputs in widths.items():
        tensors[f"features.{place}.weight"] = torch.randn(outputs, inputs, 3, 3, generator=generator) / (3 * inputs**0.5)
        bias = 0.1 * torch.randn(outputs, generator=generator) if biased else torch.zeros(outputs)
        tensors[f"features.{place}.bias"] = bias
        inputs = outputs
    return tensors


def vgg_tensors(*, means: bool) -> dict[str, Tensor]:
    """conv1_1 to conv3_1 with few channels."""
    tensors = vgg_convolutions({0: 5, 2: 6, 5: 7, 7: 7, 10: 8})
    if means:
        for place, layer in LAYERS.items():
            tensors[f"mean_activation.conv{layer}"] = 0.5 + tensors[f"features.{place}.bias"].abs()
    return tensors


def vgg_file(folder: Path, *, means: bool = True, normalisation: bool = True) -> Path:
    """A safetensors file, with Caffe's input convention in its metadata."""
    path = folder / f"vgg19-{means}-{normalisation}.safetensors"
    metadata = {"mean": json.dumps([0.485, 0.458, 0.408]), "std": json.dumps([0.5, 0.5, 0.25])}
    save_file(vgg_tensors(means=means), path, metadata if normalisation else {})
    return path
