"""Reference photographs to pixel samples: what the style dictionary is built from.

Content and semantics pass the same guided filter as the scene's training targets, at the pixels of the photograph, so that
a reference's statistics are in kind with the scene's. What moves them is the size that the encoder sees (VGG relu2_1: the
deviations change by 4 to 12 % from 512 to 384 pixels a side), so photographs are encoded at the scene's own. What doesn't
is how many pixels are looked at: every third and coarser filter cells change them by 0.6 % at most, and cost a fifth.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import cv2
import numpy as np
import torch
from torch import Tensor

from ..checks import at_least
from ..datamanagers.config import GuidedConfig
from ..datamanagers.images import Image, load_image
from ..interfaces import Encoder
from ..ops.guided import apply, coefficients
from .dictionary import Reference

if TYPE_CHECKING:
    from ..datamanagers.basis import Basis

__all__ = ["read_reference"]

_SAMPLES = 20_000
"""Pixels that are looked at, about, on a regular grid."""

_SHORTEST = 64
"""No side is encoded smaller: deep encoders have nothing to pad with on a photograph of a few pixels."""

_CELL = 16
"""Pixels between guided-filter coefficients."""

_ROWS = 4096
"""Pixels filtered at a time: bounds the memory."""


@torch.no_grad()
def read_reference(
    path: Path,
    *,
    content: Encoder,
    semantic: Encoder | None,
    basis: "Basis | None",
    longest: int = 512,
    weight: float = 1.0,
    guided: GuidedConfig | None = None,
) -> Reference:
    """Encode a photograph, reduced to `longest` pixels a side (the scene's images' own is best), and sample it.

    `basis` projects the semantics as the scene's were; without encoder or basis D is 0. `guided` is the scene's. Raises
    DataError where the file is no readable image.
    """
    at_least("longest", longest, _SHORTEST)
    image = torch.from_numpy(_reduced(load_image(path), longest)).float() / 255
    guided = GuidedConfig() if guided is None else guided
    samples = _sampled(_encode(content, image), image, guided)
    if semantic is None or basis is None:
        return Reference(path.name, samples, samples.new_zeros(len(samples), 0), weight)
    maps = _encode(semantic, image)
    # Projecting is linear and so is the filter: fewer channels first.
    maps = basis.project(maps.flatten(1).T).T.reshape(-1, *maps.shape[1:])
    return Reference(path.name, samples, _sampled(maps, image, guided), weight)


def _reduced(photo: Image, longest: int) -> Image:
    """The photograph with sides of at most `longest`, where the shape allows at least 64, and never enlarged beyond that."""
    height, width = photo.shape[:2]
    scale = min(1.0, longest / max(height, width))
    size = (max(_SHORTEST, round(width * scale)), max(_SHORTEST, round(height * scale)))
    return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _encode(encoder: Encoder, image: Annotated[Tensor, "H W 3"]) -> Annotated[Tensor, "C h w"]:
    features: Tensor = encoder(image.permute(2, 0, 1)[None])
    return features[0].float().cpu()


def _sampled(
    maps: Annotated[Tensor, "C h w"], image: Annotated[Tensor, "H W 3"], guided: GuidedConfig
) -> Annotated[Tensor, "N C"]:
    """Filtered features at every n-th pixel of every n-th row."""
    height, width = image.shape[:2]
    radius = round(guided.radius * min(height, width))
    cells = coefficients(maps, image, radius=radius, eps=guided.eps, stride=_CELL)
    step = max(1, round((height * width / _SAMPLES) ** 0.5))
    y, x = torch.meshgrid(torch.arange(step // 2, height, step), torch.arange(step // 2, width, step), indexing="ij")
    parts = zip(torch.split(x.flatten(), _ROWS), torch.split(y.flatten(), _ROWS), strict=True)
    return torch.cat([apply(cells, torch.stack([i, j], 1) + 0.5, image[j, i], (height, width)) for i, j in parts])
