"""A folder of small random photographs, and small teachers."""

from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

STRIDES = (1, 2, 1, 2, 1, 1, 2, 1, 1, 1, 1, 1, 1, 2, 1, 1, 1)


def photo_folder(folder: Path, count: int = 6) -> Path:
    """Smooth noise, of different sizes."""
    (folder / "deeper").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for index in range(count):
        small = rng.integers(0, 256, (5, 6, 3), dtype=np.uint8)
        image = cv2.resize(small, (60 + index, 50 + 2 * index), interpolation=cv2.INTER_CUBIC)
        assert cv2.imwrite(str(folder / ("deeper" if index % 2 else "") / f"{index}.png"), image)
    return folder


def mobilenet_tensors(*, folded: bool, width: int = 4, last: int = 13) -> dict[str, Tensor]:
    """MobileNetV2's structure, a few channels wide, random."""
    generator = torch.Generator().manual_seed(1)
    tensors: dict[str, Tensor] = {}

    def put(name: str, number: str, outputs: int, inputs: int, size: int) -> None:
        weight = torch.randn(outputs, inputs, size, size, generator=generator) / (inputs * size * size) ** 0.5
        if folded:
            tensors[f"backbone.{name}.{number}.weight"] = weight
            tensors[f"backbone.{name}.{number}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
            return
        norm = f"features.{name}.{int(number) + 1}"
        tensors[f"features.{name}.{number}.weight"] = weight
        for part in ("weight", "running_var"):
            tensors[f"{norm}.{part}"] = 0.5 + torch.rand(outputs, generator=generator)
        for part in ("bias", "running_mean"):
            tensors[f"{norm}.{part}"] = 0.1 * torch.randn(outputs, generator=generator)

    put("0", "0", width, 3, 3)
    for block in range(1, last + 1):
        at, wide = (1, 2 * width) if block > 1 else (0, width)
        if block > 1:
            put(f"{block}.conv.0", "0", wide, width, 1)
        put(f"{block}.conv.{at}", "0", wide, 1, 3)
        put(f"{block}.conv", str(at + 1), width, wide, 1)
    return tensors


def vgg_file(folder: Path, last: int = 6) -> Path:
    """VGG-19's shape up to conv3_4, a few filters wide and `last` of them at conv2_1, random."""
    draw = torch.Generator().manual_seed(0)
    tensors, inputs = {}, 3
    for place, outputs in {0: 4, 2: 4, 5: last, 7: 6, 10: 8, 12: 8, 14: 8, 16: 8}.items():
        tensors[f"features.{place}.weight"] = torch.randn(outputs, inputs, 3, 3, generator=draw) / (3 * inputs**0.5)
        tensors[f"features.{place}.bias"] = torch.zeros(outputs)
        inputs = outputs
    save_file(tensors, folder / "vgg.safetensors")
    return folder / "vgg.safetensors"


def teacher_files(folder: Path) -> tuple[Path, Path]:
    """MobileNetV2 with its norms, DeepLab's backbone without."""
    save_file(mobilenet_tensors(folded=False, width=26), folder / "mobilenet.safetensors")
    save_file(mobilenet_tensors(folded=True, width=25, last=17), folder / "deeplab.safetensors")
    return folder / "mobilenet.safetensors", folder / "deeplab.safetensors"
