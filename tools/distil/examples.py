"""Crops of photographs, in random light, and their cache.

Every draw is a function of a generator.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.plugins.weights import read_weights, write_weights

from .config import DistilConfig

LUMA = (0.299, 0.587, 0.114)
Pair = tuple[Tensor, Tensor]


def crop(
    photo: Annotated[Tensor, "H W 3"], size: int, scales: tuple[float, float], generator: torch.Generator
) -> Annotated[Tensor, "3 size size"]:
    """A random square, `scales` (log-uniform) times as large in the result as in the photo, mirrored half the
    time.
    """
    draw = torch.rand(4, generator=generator).tolist()
    scale = math.exp(math.log(scales[0]) + draw[0] * (math.log(scales[1]) - math.log(scales[0])))
    height, width = photo.shape[:2]
    side = max(2, min(round(size / scale), height, width))
    top = int(draw[1] * (height - side + 1))
    left = int(draw[2] * (width - side + 1))
    piece = photo[top : top + side, left : left + side].permute(2, 0, 1)[None]
    if side != size:
        smaller = side > size
        piece = F.interpolate(piece, (size, size), mode="bilinear", align_corners=False, antialias=smaller)
    piece = piece[0].clamp(0, 1)
    return piece.flip(-1) if draw[3] < 0.5 else piece


def toned(image: Annotated[Tensor, "3 H W"], generator: torch.Generator) -> Annotated[Tensor, "3 H W"]:
    """Random gamma, contrast, saturation, hue and tint; one in four times night, one in five times none at
    all.
    """
    kind = float(torch.rand(1, generator=generator))
    draw = (2 * torch.rand(8, generator=generator) - 1).tolist()
    if kind < 0.2:
        return image
    image = torch.pow(image, 2 ** (0.8 * draw[0]))
    image = 0.5 + (image - 0.5) * (1 + 0.4 * draw[1]) + 0.15 * draw[2]
    luma = torch.tensor(LUMA, dtype=image.dtype).view(3, 1, 1)
    grey = (image * luma).sum(0, keepdim=True)
    image = grey + (image - grey) * (1 + 0.8 * draw[3])
    image = _turned(image, 0.5 * draw[4])
    tint = 1 + 0.25 * torch.tensor(draw[5:8])
    image = (image * tint.view(3, 1, 1)).clamp(0, 1)
    return nightfall(image, generator) if kind > 0.75 else image


def nightfall(image: Annotated[Tensor, "3 H W"], generator: torch.Generator) -> Annotated[Tensor, "3 H W"]:
    """Dark, bluish or orange, grainy: day as a night photograph shows it."""
    draw = torch.rand(4, generator=generator).tolist()
    cold = torch.tensor([0.7, 0.85, 1.3]) if draw[1] < 0.6 else torch.tensor([1.3, 0.95, 0.6])
    dark = torch.pow(image, 1.2 + draw[2]) * (0.25 + 0.4 * draw[0]) * cold.view(3, 1, 1)
    grain = 0.03 * draw[3] * torch.randn(image.shape, generator=generator)
    return torch.clamp(dark + grain, 0, 1)


def _turned(image: Tensor, angle: float) -> Tensor:
    """Colours turned about the grey axis by `angle` in radians (Rodrigues)."""
    axis = torch.full((3,), 3**-0.5)
    cross = torch.tensor([[0.0, -1.0, 1.0], [1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]]) * 3**-0.5
    cosine = torch.cos(torch.tensor(angle))
    sine = torch.sin(torch.tensor(angle))
    matrix = cosine * torch.eye(3) + sine * cross + (1 - cosine) * torch.outer(axis, axis)
    return torch.einsum("ij,jhw->ihw", matrix, image)


def prepared_path(output: Path) -> Path:
    """Where the crops of an unfinished run lie."""
    return output.with_name(output.name + ".prepared")


def prepared(make: Callable[[], Pair], config: DistilConfig, output: Path) -> Pair:
    """Inputs and targets: those of an interrupted run that would prepare the same, or made anew and kept."""
    path = prepared_path(output)
    if path.is_file():
        tensors, metadata = read_weights(path)
        if metadata.get("key") == _crops_key(config):
            return tensors["inputs"], tensors["targets"]
    inputs, targets = make()
    write_weights(path, {"inputs": inputs, "targets": targets}, {"key": _crops_key(config)})
    return inputs, targets


def _crops_key(config: DistilConfig) -> str:
    """What the crops depend on: a run may be made longer without preparing them again."""
    free = replace(config, output=None, minutes=1.0, steps=None, batch=1, rate=1.0, device="auto")
    return repr(free)
