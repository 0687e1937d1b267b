"""Small files in the shape of MobileNetV2's, of DeepLab's backbone and of VGG-19's, with random weights."""

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor


class Draw:
    """Random tensors under names, of the size that keeps activations O(1)."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.tensors: dict[str, Tensor] = {}

    def convolution(self, name: str, outputs: int, inputs: int, size: int, *, bias: bool = False) -> None:
        """`inputs` of each group."""
        scale = (1.5 / (inputs * size * size)) ** 0.5
        self.tensors[f"{name}.weight"] = scale * torch.randn(
            outputs, inputs, size, size, generator=self.generator
        )
        if bias:
            self.tensors[f"{name}.bias"] = 0.1 * torch.randn(outputs, generator=self.generator)

    def norm(self, name: str, channels: int) -> None:
        for part in ("weight", "running_var"):
            self.tensors[f"{name}.{part}"] = 0.5 + torch.rand(channels, generator=self.generator)
        for part in ("bias", "running_mean"):
            self.tensors[f"{name}.{part}"] = 0.1 * torch.randn(channels, generator=self.generator)
        self.tensors[f"{name}.num_batches_tracked"] = torch.tensor(7)


def mobilenet_tensors(*, folded: bool, width: int = 4) -> dict[str, Tensor]:
    """torchvision's names and norms, or DeepLab's backbone without."""
    draw = Draw(1)
    start = "backbone." if folded else "features."

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


LAYERS = {0: "1_1", 2: "1_2", 5: "2_1", 7: "2_2", 10: "3_1"}


def vgg_convolutions(widths: Mapping[int, int], *, seed: int = 3, biased: bool = True) -> dict[str, Tensor]:
    """Convolutions of so many filters at places of torchvision's `features`."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    inputs = 3
    for place, outputs in widths.items():
        tensors[f"features.{place}.weight"] = torch.randn(outputs, inputs, 3, 3, generator=generator) / (
            3 * inputs**0.5
        )
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
