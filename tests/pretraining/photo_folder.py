"""A folder of small random photographs, and small teachers."""

from pathlib import Path

import cv2
import numpy as np
from network_files import mobilenet_tensors, vgg_convolutions
from safetensors.torch import save_file


def photo_folder(folder: Path, count: int = 6) -> Path:
    """Smooth noise, of different sizes."""
    (folder / "deeper").mkdir(parents=True)
    rng = np.random.default_rng(0)
    for index in range(count):
        small = rng.integers(0, 256, (5, 6, 3), dtype=np.uint8)
        image = cv2.resize(small, (60 + index, 50 + 2 * index), interpolation=cv2.INTER_CUBIC)
        assert cv2.imwrite(str(folder / ("deeper" if index % 2 else "") / f"{index}.png"), image)
    return folder


def vgg_file(folder: Path, last: int = 6) -> Path:
    """VGG-19's shape up to conv3_4, a few filters wide and `last` of them at conv2_1."""
    widths = {0: 4, 2: 4, 5: last, 7: 6, 10: 8, 12: 8, 14: 8, 16: 8}
    save_file(vgg_convolutions(widths, seed=0, biased=False), folder / "vgg.safetensors")
    return folder / "vgg.safetensors"


def teacher_files(folder: Path) -> tuple[Path, Path]:
    """MobileNetV2 with its norms, DeepLab's backbone without."""
    save_file(mobilenet_tensors(folded=False, width=26), folder / "mobilenet.safetensors")
    save_file(mobilenet_tensors(folded=True, width=25), folder / "deeplab.safetensors")
    return folder / "mobilenet.safetensors", folder / "deeplab.safetensors"
