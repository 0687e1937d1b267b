"""Small files in the shape of VGG's, with random weights."""

import json
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

WIDTHS = {0: (3, 5), 2: (5, 6), 5: (6, 7), 7: (7, 7), 10: (7, 8)}
LAYERS = {0: "1_1", 2: "1_2", 5: "2_1", 7: "2_2", 10: "3_1"}


def vgg_tensors(*, means: bool) -> dict[str, Tensor]:
    """conv1_1 to conv3_1 with few channels."""
    generator = torch.Generator().manual_seed(3)
    tensors = {}
    for place, (inputs, outputs) in WIDTHS.items():
        tensors[f"features.{place}.weight"] = torch.randn(outputs, inputs, 3, 3, generator=generator) / (3 * inputs**0.5)
        tensors[f"features.{place}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
        if means:
            tensors[f"mean_activation.conv{LAYERS[place]}"] = 0.5 + torch.rand(outputs, generator=generator)
    return tensors


def vgg_file(folder: Path, *, means: bool = True, normalisation: bool = True) -> Path:
    """A safetensors file, with Caffe's input convention in its metadata."""
    path = folder / f"vgg19-{means}-{normalisation}.safetensors"
    metadata = {"mean": json.dumps([0.485, 0.458, 0.408]), "std": json.dumps([0.5, 0.5, 0.25])}
    save_file(vgg_tensors(means=means), path, metadata if normalisation else {})
    return path


def deep_vgg_file(folder: Path) -> Path:
    """Three channels at every place where one of the two networks has a convolution, up to its conv4_1."""
    generator = torch.Generator().manual_seed(4)
    tensors = {}
    for place in (0, 2, 5, 7, 10, 12, 14, 16, 17, 19):
        tensors[f"features.{place}.weight"] = torch.randn(3, 3, 3, 3, generator=generator) / 5
        tensors[f"features.{place}.bias"] = 0.1 * torch.randn(3, generator=generator)
    save_file(tensors, folder / "deep.safetensors")
    return folder / "deep.safetensors"
