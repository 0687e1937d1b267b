"""Other light on the same picture: what a semantic encoder must not see, and what a content encoder meets at night."""

from typing import Annotated

import torch
from torch import Tensor

__all__ = ["nightfall", "toned"]

LUMA = (0.299, 0.587, 0.114)


def toned(image: Annotated[Tensor, "3 H W"], generator: torch.Generator) -> Annotated[Tensor, "3 H W"]:
    """Random gamma, contrast, saturation, hue and tint; one in four times night, one in five times none at all."""
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
    cosine, sine = torch.cos(torch.tensor(angle)), torch.sin(torch.tensor(angle))
    matrix = cosine * torch.eye(3) + sine * cross + (1 - cosine) * torch.outer(axis, axis)
    return torch.einsum("ij,jhw->ihw", matrix, image)
