"""Photographs to learn from: found, split, cropped, shown in another light, and their guided-filtered features.

Every draw is a function of a generator.
"""

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.config import GuidedConfig
from ..datamanagers.images import load_image
from ..errors import DataError
from ..interfaces import Encoder
from ..ops.guided import apply, coefficients, upsample

__all__ = [
    "crop",
    "filtered_at",
    "filtered_crop",
    "filtered_whole",
    "find_photos",
    "load_photo",
    "nightfall",
    "random_pixels",
    "split",
    "toned",
]


SUFFIXES = (".jpg", ".jpeg", ".png")
HELD_OUT = 12
"""One photograph in so many is held out."""


def find_photos(folders: Sequence[Path]) -> list[Path]:
    """Every JPEG and PNG below the folders, in the order of a hash of their names: any prefix is a fair sample."""
    for folder in folders:
        if not folder.is_dir():
            raise DataError(f"{folder}: no such folder of photographs; name existing ones with --images DIR ...")
    found = [path for folder in folders for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES]
    if len(found) < 2:
        listed = ", ".join(str(folder) for folder in folders) or "no folder"
        raise DataError(f"{listed}: {len(found)} photographs; at least 2 are needed: name more with --images DIR ...")
    return sorted(found, key=lambda path: (hashlib.sha256(path.name.encode()).digest(), str(path)))


def split(photos: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Training and held-out photographs; the same split for the same names."""
    held = max(1, len(photos) // HELD_OUT)
    return list(photos[held:]), list(photos[:held])


def load_photo(path: Path, longest: int | None = None) -> Annotated[Tensor, "H W 3"]:
    """sRGB in [0, 1], reduced to `longest` pixels where it is larger."""
    pixels = torch.from_numpy(load_image(path)).float() / 255
    side = max(pixels.shape[:2])
    if longest is None or side <= longest:
        return pixels
    size = [max(1, round(n * longest / side)) for n in pixels.shape[:2]]
    smaller = F.interpolate(pixels.permute(2, 0, 1)[None], size, mode="area")[0]
    return smaller.permute(1, 2, 0).contiguous()


def crop(
    photo: Annotated[Tensor, "H W 3"], size: int, scales: tuple[float, float], generator: torch.Generator
) -> Annotated[Tensor, "3 size size"]:
    """A random square, `scales` (log-uniform) times as large in the result as in the photo, mirrored half the time."""
    draw = torch.rand(4, generator=generator).tolist()
    scale = math.exp(math.log(scales[0]) + draw[0] * (math.log(scales[1]) - math.log(scales[0])))
    height, width = photo.shape[:2]
    side = max(2, min(round(size / scale), height, width))
    top, left = int(draw[1] * (height - side + 1)), int(draw[2] * (width - side + 1))
    piece = photo[top : top + side, left : left + side].permute(2, 0, 1)[None]
    if side != size:
        smaller = side > size
        piece = F.interpolate(piece, (size, size), mode="bilinear", align_corners=False, antialias=smaller)
    piece = piece[0].clamp(0, 1)
    return piece.flip(-1) if draw[3] < 0.5 else piece


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
