"""Photographs to learn from: found, split, cropped, shown in another light, and their guided-filtered
features.

Every draw is a function of a generator.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import DataError
from ..interfaces import Encoder
from ..ops.backend import float32_convolutions
from ..ops.config import GuidedConfig
from ..ops.guided import apply, coefficients, upsample

SUFFIXES = (".jpg", ".jpeg", ".png")
HELD_OUT = 12
"""One photograph in so many is held out."""
GUIDED = GuidedConfig()
"""The filter that features of a scene pass."""


def find_photos(folders: Sequence[Path]) -> list[Path]:
    """Every JPEG and PNG below the folders, in the order of a hash of their names: any prefix is a fair
    sample.
    """
    for folder in folders:
        if not folder.is_dir():
            raise DataError(
                f"{folder}: no such folder of photographs; name existing ones with --images DIR ..."
            )
    photos = []
    for folder in folders:
        for path in folder.rglob("*"):
            if path.suffix.lower() in SUFFIXES:
                photos.append(path)
    if len(photos) < 2:
        listed = ", ".join(str(folder) for folder in folders) or "no folder"
        raise DataError(
            f"{listed}: {len(photos)} photographs; at least 2 are needed: name more with --images DIR ..."
        )
    return sorted(photos, key=lambda path: (hashlib.sha256(path.name.encode()).digest(), str(path)))


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
    # Area means: a smaller photograph must not alias.
    size = []
    for n in pixels.shape[:2]:
        size.append(max(1, round(n * longest / side)))
    smaller = F.interpolate(pixels.permute(2, 0, 1)[None], size, mode="area")[0]
    return smaller.permute(1, 2, 0).contiguous()


def random_pixels(
    photo: Annotated[Tensor, "H W 3"], count: int, generator: torch.Generator
) -> Annotated[Tensor, "N 2"]:
    """Row and column indices, int64, drawn with replacement."""
    height, width = photo.shape[:2]
    index = torch.randint(0, height * width, (count,), generator=generator)
    return torch.stack([index // width, index % width], 1)


@torch.no_grad()
def filtered_at(
    encoder: Encoder, photo: Annotated[Tensor, "H W 3"], pixels: Annotated[Tensor, "N 2"]
) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N 3"]]:
    """Features and colours at pixels (row, column)."""
    height, width = photo.shape[:2]
    pixels = pixels.to(photo.device)
    with float32_convolutions(photo.device):
        features: Tensor = encoder(photo.permute(2, 0, 1)[None])[0]
    # Features are filtered along the photograph's edges, as those of a scene are (guided filter).
    coefs = coefficients(features, photo, radius=_radius(photo), eps=GUIDED.eps, stride=GUIDED.stride)
    rgb = photo[pixels[:, 0], pixels[:, 1]]
    return apply(coefs, pixels.flip(1) + 0.5, rgb, (height, width)), rgb


@torch.no_grad()
def filtered_crop(
    encoder: Encoder, photo: Annotated[Tensor, "H W 3"], side: int, generator: torch.Generator
) -> tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N 3"]]:
    """Features and colours of a random square of the photograph, row by row; the whole of it was encoded."""
    # The whole photograph is encoded, so that a crop's features know what lies around it.
    top, left = (int(torch.randint(0, size - side + 1, (), generator=generator)) for size in photo.shape[:2])
    rows, columns = torch.meshgrid(top + torch.arange(side), left + torch.arange(side), indexing="ij")
    return filtered_at(encoder, photo, torch.stack([rows.flatten(), columns.flatten()], 1))


@torch.no_grad()
def filtered_whole(encoder: Encoder, photo: Annotated[Tensor, "H W 3"]) -> Annotated[Tensor, "N C"]:
    """Features at every pixel, row by row."""
    with float32_convolutions(photo.device):
        features: Tensor = encoder(photo.permute(2, 0, 1)[None])[0]
    return upsample(features, photo, radius=_radius(photo), eps=GUIDED.eps, stride=GUIDED.stride).flatten(
        0, 1
    )


def _radius(photo: Annotated[Tensor, "H W 3"]) -> int:
    return round(GUIDED.radius * min(photo.shape[:2]))
