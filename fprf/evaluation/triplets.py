"""Pairs of photographs whose corresponding parts somebody painted in the same colours: the truth of semantic matching.

FOLDER/content/NAME.jpg, FOLDER/style/NAME.jpg, FOLDER/segmentation/NAME_content.png and NAME_style.png; the layout, and the
nine colours, of Luan et al. 2017 (deep photo style transfer).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import DataError

__all__ = ["COLOURS", "SIZE", "Triplet", "read_regions", "read_triplets", "triplet_names"]

COLOURS = ("black", "white", "blue", "green", "red", "yellow", "magenta", "cyan", "grey")
"""Names by region id."""
_CODES = (0x000000, 0xFFFFFF, 0x0000FF, 0x00FF00, 0xFF0000, 0xFFFF00, 0xFF00FF, 0x00FFFF, 0x808080)

SIZE = (512, 384)
"""Width and height at which the matching measure sees every photograph."""


class Triplet(NamedTuple):
    """Two photographs [H W 3], sRGB in [0, 1], and their painted regions [H W], int64 in 0..8. Sizes may differ."""

    name: str
    content: Annotated[Tensor, "H W 3"]
    style: Annotated[Tensor, "G F 3"]
    content_regions: Annotated[Tensor, "H W"]
    style_regions: Annotated[Tensor, "G F"]


def triplet_names(folder: Path) -> list[str]:
    """Sorted. Raises DataError where there is none."""
    names = sorted(path.stem for path in (folder / "content").glob("*.jpg"))
    if not names:
        raise DataError(f"{folder}: no content/*.jpg; name a folder with content, style and segmentation")
    return names


def read_triplets(folder: Path, *, names: Sequence[str] = (), size: tuple[int, int] | None = SIZE) -> list[Triplet]:
    """The triplets of a folder, or those named; photographs at `size` (None: as they are), regions always as painted.

    Raises DataError for a file that is absent, unreadable or painted in other colours.
    """
    return [
        Triplet(
            name,
            _photo(folder / "content" / f"{name}.jpg", size),
            _photo(folder / "style" / f"{name}.jpg", size),
            read_regions(folder / "segmentation" / f"{name}_content.png"),
            read_regions(folder / "segmentation" / f"{name}_style.png"),
        )
        for name in (names or triplet_names(folder))
    ]


def read_regions(path: Path) -> Annotated[Tensor, "H W"]:
    """Region ids of a painted mask. Raises DataError for colours that are none of the nine."""
    pixels = load_image(path).astype(np.int64)
    code = (pixels[..., 0] << 16) | (pixels[..., 1] << 8) | pixels[..., 2]
    found = np.full(code.shape, -1, dtype=np.int64)
    for region, colour in enumerate(_CODES):
        found[code == colour] = region
    if (found < 0).any():
        raise DataError(f"{path}: {float((found < 0).mean()):.1%} of the pixels have none of the colours {', '.join(COLOURS)}")
    return torch.from_numpy(found)


def _photo(path: Path, size: tuple[int, int] | None) -> Annotated[Tensor, "H W 3"]:
    return torch.from_numpy(load_image(path, size)).float() / 255
