"""Features of an encoder's cells brought to pixels: colours explain them where cells are means over pixels.

An encoder's cell shows several things at the border of two, and its features are about the mean of theirs. A
filter that regresses interpolated features on the colours of pixels (`guided`) finds slopes that are too
small by as much as cells blur: a twig before the sky stays half sky. Here the features of cells are regressed
on the mean colours of the same cells, in windows of a few cells:

    f_j  ~  A^T m_j + b      over the cells j of a window,  m_j the mean colour of cell j
    F(p)  =  A(p)^T I(p) + b(p)      at a pixel p of colour I(p)

Means of an affine function are the function of the means, so what is true of the cells' means is true of
pixels. Where features do not differ A is 0, whatever the colours are. A and b are means over the windows that
a cell lies in, bilinear between cells.

Letters: I guide [H W 3] sRGB in [0, 1]; f features [C h w], cell (i, j) covering its part of the whole image.
Windows are squares of 2 reach + 1 cells, cut at the border. Statistics are float64.
"""

from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError
from .backend import float64_device
from .guided import interpolation

_ROWS = 8
"""Rows of pixels at a time: what they take stays in the cache of a core (a third of the time of all rows)."""


def cell_maps(
    features: Annotated[Tensor, "C h w"], guide: Annotated[Tensor, "H W 3"], *, reach: int, eps: float
) -> Annotated[Tensor, "h w 4 C"]:
    """A (three rows) and b of each cell, float32.

    `eps` in squared colour units (> 0) keeps slopes small where the cells of a window differ little in
    colour. Raises DataError for shapes that do not fit.
    """
    if features.ndim != 3 or guide.ndim != 3 or guide.shape[-1] != 3 or min(features.shape + guide.shape) < 1:
        raise DataError(
            f"cell regression: features {tuple(features.shape)} and guide {tuple(guide.shape)}; "
            "give non-empty [C h w] and [H W 3]"
        )
    wide = float64_device(features.device)
    cells = features.shape[1:]
    value = features.detach().to(device=wide, dtype=torch.float64)
    colour = guide.detach().to(device=wide, dtype=torch.float64).permute(2, 0, 1)[None]
    colour = F.interpolate(colour, cells, mode="area")[0]
    # Centred before they are multiplied; b is of the whole in the end.
    grey = colour.mean((1, 2), keepdim=True)
    middle = value.mean((1, 2), keepdim=True)
    colour = colour - grey
    value = value - middle

    # A = (cov(m, m) + eps)^-1 cov(m, f) and b = mean(f) - A^T mean(m) in every window.
    mean = _window_mean(colour, reach).permute(1, 2, 0)
    target = _window_mean(value, reach).permute(1, 2, 0)
    square = _window_mean((colour[:, None] * colour).flatten(0, 1), reach).permute(1, 2, 0)
    product = _window_mean((colour[:, None] * value).flatten(0, 1), reach).permute(1, 2, 0)
    spread = square.reshape(*cells, 3, 3) - mean[..., :, None] * mean[..., None, :]
    shared = product.reshape(*cells, 3, -1) - mean[..., :, None] * target[..., None, :]
    slope = torch.linalg.solve(spread + eps * torch.eye(3).to(spread), shared)
    offset = target - (mean[..., None] * slope).sum(2)
    maps: Tensor = torch.cat([slope, offset[:, :, None]], 2)
    # The mean over all windows that a cell lies in.
    maps = _window_mean(maps.flatten(2).permute(2, 0, 1), reach).permute(1, 2, 0).reshape(*cells, 4, -1)
    maps[:, :, 3] += middle[:, 0, 0] - (grey[:, 0, 0, None] * maps[:, :, :3]).sum(2)
    return maps.to(device=features.device, dtype=torch.float32)


def apply_cell_maps(
    maps: Annotated[Tensor, "h w 4 C"], guide: Annotated[Tensor, "H W 3"]
) -> Annotated[Tensor, "H W C"]:
    """A(p)^T I(p) + b(p) at all pixels, float32."""
    height, width = guide.shape[:2]
    rows, columns, _, channels = maps.shape
    # Bilinear between cells: first along columns, where there are few numbers, then along rows of pixels.
    down = interpolation(rows, height).T.to(maps)
    across = interpolation(columns, width).T.to(maps)
    strips = (down @ maps.flatten(1)).view(height, columns, 4 * channels)
    result = maps.new_empty(height, width, channels)
    for start in range(0, height, _ROWS):
        some = slice(start, start + _ROWS)
        dense = (across @ strips[some]).view(-1, width, 4, channels)
        part = dense[:, :, 3].clone()
        for axis in range(3):
            part.addcmul_(dense[:, :, axis], guide[some, :, axis, None].to(part))
        result[some] = part
    return result


def _window_mean(x: Annotated[Tensor, "C h w"], reach: int) -> Annotated[Tensor, "C h w"]:
    """Means over windows of cells, of those inside of the image."""
    side = 2 * reach + 1
    return F.avg_pool2d(x[None], side, 1, reach, count_include_pad=False)[0]
