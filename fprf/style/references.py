"""Reference photographs to pixel samples: what the style dictionary is built from.

Content and semantics pass the same guided filter as the scene's training targets, at the pixels of the photograph, so that
a reference's statistics are in kind with the scene's. What moves them is the size that the encoder sees (VGG relu2_1: the
deviations change by 4 to 12 % from 512 to 384 pixels a side), so photographs are encoded at the scene's own. What doesn't
is how many pixels are looked at: every third and coarser filter cells change them by 0.6 % at most, and cost a fifth.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..datamanagers.config import GuidedConfig
from ..datamanagers.images import Image, load_image, load_mask
from ..errors import DataError
from ..interfaces import Encoder
from ..ops.guided import apply, coefficients
from .dictionary import Reference

if TYPE_CHECKING:
    from ..datamanagers.basis import Basis
    from .scene import SceneStyle

_SAMPLES = 20_000
"""Pixels that are looked at, about, on a regular grid."""

SHORTEST_REFERENCE = 128
"""References are encoded at the scene's size, but not below this: clusters would have too few pixels."""
_SHORTEST = 64
"""No side is encoded smaller: deep encoders have nothing to pad with on a photograph of a few pixels."""

_CELL = 16
"""Pixels between guided-filter coefficients."""

_ROWS = 4096
"""Pixels filtered at a time: bounds the memory."""


class Encoders(NamedTuple):
    """Encoders and basis for references of a scene: loaded once for any number of styles."""

    content: Encoder
    semantic: Encoder | None
    basis: "Basis | None"
    scene: "SceneStyle"
    device: torch.device = torch.device("cpu")
    """Device of the encoders."""
    longest: int = 512
    """Longest side in pixels at which photographs are encoded: that of the scene's own views."""
    guided: GuidedConfig = GuidedConfig()
    """The filter that features of the scene's own images passed."""
    seed: int = 0
    """Of the clusters of a style dictionary."""


@torch.inference_mode()
def encode_photograph(path: Path, encoders: Encoders, *, name: str, weight: float = 1.0, mask: Path | None = None) -> Reference:
    """One photograph as samples in the scene's terms: D is 0 without a semantic encoder or basis.

    Of a photograph with a `mask`, a picture of the same shape, only what is white there is sampled; the encoders see all of
    it. Raises DataError where a file is no readable image, or a mask does not fit.
    """
    photo = load_image(path, upright=True)
    image = torch.from_numpy(_reduced(photo, max(encoders.longest, SHORTEST_REFERENCE))).to(encoders.device).float() / 255
    height, width = image.shape[:2]
    pixel = _grid(height, width) if mask is None else _inside(_mask(mask, path, photo, (width, height)))
    pixel = pixel.to(image.device)
    samples, colour = _sampled(_encode(encoders.content, image), image, pixel, encoders.guided), image[pixel[:, 1], pixel[:, 0]]
    if encoders.semantic is None or encoders.basis is None:
        return Reference(name, samples, samples.new_zeros(len(samples), 0), weight, colour)
    semantic, beyond = semantic_samples(image, pixel, encoders.semantic, encoders.basis, encoders.guided)
    return Reference(name, samples, semantic, weight, colour, beyond)


def semantic_samples(
    image: Annotated[Tensor, "H W 3"], pixel: Annotated[Tensor, "N 2"], encoder: Encoder, basis: "Basis", guided: GuidedConfig
) -> tuple[Annotated[Tensor, "N D"], Annotated[Tensor, "N"]]:
    """Filtered semantics at pixels (x, y, int64) in a scene's basis, and what of them lies beyond it (`Basis.beyond`)."""
    maps = _encode(encoder, image)
    cells = maps.flatten(1).T
    low = basis.project(cells)
    # Projecting is linear and so is the filter: fewer channels first.
    fewer = torch.cat([low, basis.beyond(cells, low)], 1).T.reshape(-1, *maps.shape[1:])
    found = _sampled(fewer, image, pixel, guided)
    return found[:, :-1].contiguous(), found[:, -1].clamp_min(0)


def _reduced(photo: Image, longest: int) -> Image:
    """The photograph with sides of at most `longest`, where the shape allows at least 64, and never enlarged beyond that."""
    height, width = photo.shape[:2]
    scale = min(1.0, longest / max(height, width))
    size = (max(_SHORTEST, round(width * scale)), max(_SHORTEST, round(height * scale)))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _encode(encoder: Encoder, image: Annotated[Tensor, "H W 3"]) -> Annotated[Tensor, "C h w"]:
    features: Tensor = encoder(image.permute(2, 0, 1)[None])
    return features[0].float()


def _sampled(
    maps: Annotated[Tensor, "C h w"], image: Annotated[Tensor, "H W 3"], pixel: Annotated[Tensor, "N 2"], guided: GuidedConfig
) -> Annotated[Tensor, "N C"]:
    """Filtered features at pixels (x, y, int64)."""
    height, width = image.shape[:2]
    radius = round(guided.radius * min(height, width))
    cells = coefficients(maps, image, radius=radius, eps=guided.eps, stride=_CELL)
    parts = torch.split(pixel, _ROWS)
    return torch.cat([apply(cells, at + 0.5, image[at[:, 1], at[:, 0]], (height, width)) for at in parts])


def _grid(height: int, width: int) -> Annotated[Tensor, "N 2"]:
    """Every n-th pixel of every n-th row."""
    step = max(1, round((height * width / _SAMPLES) ** 0.5))
    y, x = torch.meshgrid(torch.arange(step // 2, height, step), torch.arange(step // 2, width, step), indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], 1)


def _inside(mask: Annotated[Tensor, "H W"]) -> Annotated[Tensor, "N 2"]:
    """Every n-th pixel of the mask: a small one is looked at closely."""
    pixel = mask.nonzero().flip(1)
    step = max(1, round(len(pixel) / _SAMPLES))
    return pixel[step // 2 :: step]


def _mask(path: Path, photo_path: Path, photo: Image, size: tuple[int, int]) -> Annotated[Tensor, "H W"]:
    """A mask at that size (width, height), bool: at least half covered, else whatever is covered at all."""
    white = load_mask(path, upright=True)
    (height, width), (own_height, own_width) = white.shape, photo.shape[:2]
    if abs(width * own_height - height * own_width) > 0.5 * (width + height + own_width + own_height):
        raise DataError(
            f"{path}: a mask of {width}x{height} pixels does not fit {photo_path.name} of {own_width}x{own_height}; "
            "draw it on the photograph itself"
        )
    cover = torch.from_numpy(np.asarray(cv2.resize(white.astype(np.float32), size, interpolation=cv2.INTER_AREA)))
    selected = cover >= 0.5 if bool((cover >= 0.5).any()) else cover > 0
    if not bool(selected.any()):
        raise DataError(f"{path}: the mask selects no pixel of {photo_path.name}; paint white what makes the style")
    return selected
