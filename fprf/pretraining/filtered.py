"""Features at single pixels as scene training sees them: guided-filtered by the photograph itself."""

from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.config import GuidedConfig
from ..interfaces import Encoder
from ..ops.guided import apply, coefficients, upsample

__all__ = ["filtered_at", "filtered_crop", "filtered_whole", "random_pixels"]


def random_pixels(photo: Annotated[Tensor, "H W 3"], count: int, generator: torch.Generator) -> Annotated[Tensor, "N 2"]:
    """Row and column indices, int64, drawn with replacement."""
    height, width = photo.shape[:2]
    index = torch.randint(0, height * width, (count,), generator=generator)
    return torch.stack([index // width, index % width], 1)


@torch.no_grad()
def filtered_at(
    encoder: Encoder, photo: Annotated[Tensor, "H W 3"], pixels: Annotated[Tensor, "N 2"], guided: GuidedConfig
) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N 3"]]:
    """Features and colours at pixels (row, column)."""
    height, width = photo.shape[:2]
    pixels = pixels.to(photo.device)
    features = encoder(photo.permute(2, 0, 1)[None])[0]
    coefs = coefficients(features, photo, radius=_radius(photo, guided), eps=guided.eps, stride=guided.stride)
    rgb = photo[pixels[:, 0], pixels[:, 1]]
    return apply(coefs, pixels.flip(1) + 0.5, rgb, (height, width)), rgb


@torch.no_grad()
def filtered_crop(
    encoder: Encoder, photo: Annotated[Tensor, "H W 3"], side: int, guided: GuidedConfig, generator: torch.Generator
) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N 3"]]:
    """Features and colours of a random square of the photograph, row by row; the whole of it was encoded."""
    top, left = (int(torch.randint(0, size - side + 1, (), generator=generator)) for size in photo.shape[:2])
    rows, columns = torch.meshgrid(top + torch.arange(side), left + torch.arange(side), indexing="ij")
    return filtered_at(encoder, photo, torch.stack([rows.flatten(), columns.flatten()], 1), guided)


@torch.no_grad()
def filtered_whole(encoder: Encoder, photo: Annotated[Tensor, "H W 3"], guided: GuidedConfig) -> Annotated[Tensor, "N C"]:
    """Features at every pixel, row by row."""
    features = encoder(photo.permute(2, 0, 1)[None])[0]
    radius = _radius(photo, guided)
    return upsample(features, photo, radius=radius, eps=guided.eps, stride=guided.stride).flatten(0, 1)


def _radius(photo: Annotated[Tensor, "H W 3"], guided: GuidedConfig) -> int:
    return round(guided.radius * min(photo.shape[:2]))
