"""Photographs to learn from: found, split, loaded, cropped. Every draw is a function of a generator."""

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import DataError

__all__ = ["crop", "find_photos", "load_photo", "split"]

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
