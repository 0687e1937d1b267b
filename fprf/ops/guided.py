"""Edge-aware upsampling of feature maps: the colour guided filter (He et al. 2010) in the form of a few
coefficients.

The filter's output is linear in the guide, F(p) = A(p) I(p) + b(p), where A and b are means over windows and
so smooth: they are kept at a stride, as the cells whose bilinear interpolation is closest to them in least
squares (half the error of area averages), and interpolated at the pixels that somebody asks for.

Letters: I guide [H W 3] sRGB in [0, 1]; f features [C h w], cell (i, j) covering its part of the whole image;
p = f bilinearly upsampled to the guide (align_corners=False). Windows are squares of 2 radius + 1 pixels, cut
at the border.

How it stays cheap: covariances always see every pixel of the guide, the features only at *nodes*. p is a sum
of hat functions, p = sum_k f_k hat_k, so sum I p over a window = sum_k f_k (sum I hat_k), and the bracket has
three channels, not C. Nodes are the feature cells, split by an odd factor (which represents p exactly) until
a window is `fineness` nodes wide; windows are solved at centres as far apart. What is approximate is only the
window's edge, soft by one node. With fineness = inf the nodes and centres are the pixels, and the filter is
exact. Sums are small dense matrices per axis, not running sums: nothing accumulates. Guide statistics are
float64, features are centred before they are multiplied.
"""

import math
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError
from .backend import float64_device

FINENESS = 10.0
"""Nodes in a window's width. Measured on photographs: 8 to 12 cost a tenth of the error that the stride brings
anyway, 6 doubles it.
"""
GROUP = 1 << 24
"""Largest intermediate, in elements (64 MiB of float32): channels are worked on in groups that fit; by eye."""


class _Axis(NamedTuple):
    """The filter along one axis of n pixels: m nodes, c window centres, s stored cells. All float64."""

    hat: Annotated[Tensor, "m n"]
    """Weight of each node at each pixel (the adjoint of bilinear upsampling)."""
    window: Annotated[Tensor, "c m"]
    """Share of each node in each window, divided by the window's mass."""
    keep: Annotated[Tensor, "s c"]
    """Mean over windows, then the cells whose bilinear interpolation is closest to it."""


def coefficients(
    features: Annotated[Tensor, "C h w"],
    guide: Annotated[Tensor, "H W 3"],
    *,
    radius: int,
    eps: float,
    stride: int,
    fineness: float = FINENESS,
) -> Annotated[Tensor, "s t C 4"]:
    """A (three numbers) and b of every channel, float32, in ceil(H / stride) x ceil(W / stride) equal cells
    of the image.

    `radius` in pixels (>= 0), `eps` in squared colour units (>= 1e-6: below, float32 features no longer carry
    the answer). Raises DataError for shapes that do not fit.
    """
    if features.ndim != 3 or guide.ndim != 3 or guide.shape[-1] != 3 or min(features.shape + guide.shape) < 1:
        raise DataError(
            f"guided filter: features {tuple(features.shape)} and guide {tuple(guide.shape)}; "
            "give non-empty [C h w] and [H W 3]"
        )
    height, width = guide.shape[:2]
    y = _axis(height, features.shape[1], radius, stride, fineness)
    x = _axis(width, features.shape[2], radius, stride, fineness)

    # Statistics of the guide, float64 and about its mean.
    wide = float64_device(features.device)
    y = _Axis(*(operator.to(wide) for operator in y))
    x = _Axis(*(operator.to(wide) for operator in x))
    pixels = guide.detach().to(device=wide, dtype=torch.float64).permute(2, 0, 1)
    colour = pixels.mean((1, 2), keepdim=True)
    pixels = pixels - colour
    mean, inverse = _statistics(pixels, y, x, eps)
    weights = torch.cat([pixels.new_ones(1, height, width), pixels])
    moments = y.hat @ (weights @ x.hat.T)

    def ready(z: Tensor) -> Tensor:
        return z.to(device=features.device, dtype=torch.float32)

    # Then the features, float32, a group of channels at a time.
    mean, inverse, moments, colour = (ready(z) for z in (mean, inverse, moments, colour.reshape(3, 1, 1, 1)))
    operators = [ready(m) for m in (y.window, x.window.T, y.keep, x.keep.T)]
    channels = features.shape[0]
    result = torch.empty(len(y.keep), len(x.keep), channels, 4, device=features.device)
    group = max(1, GROUP // (4 * moments[0].numel()))
    for first in range(0, channels, group):
        part = features[first : first + group].float()
        result[:, :, first : first + group] = _solve(part, mean, inverse, moments, colour, operators).permute(
            2, 3, 1, 0
        )
    return result


def apply(
    coefs: Annotated[Tensor, "s t C 4"],
    pixel: Annotated[Tensor, "R 2"],
    rgb: Annotated[Tensor, "R 3"],
    size: tuple[int, int],
) -> Annotated[Tensor, "R C"]:
    """Features at pixel positions (x, y; centres at +0.5) of an image of `size` (height, width), float32."""
    cells = torch.tensor(coefs.shape[:2], device=pixel.device)
    row, column, share = _corners(pixel, cells, torch.tensor(size, device=pixel.device))
    flat = (row[:, :, None] * coefs.shape[1] + column[:, None, :]).flatten(1)
    colour = torch.cat([rgb.float(), torch.ones_like(rgb[:, :1], dtype=torch.float32)], 1)
    # Sixteen rows of channels a pixel, four of each corner, summed without R x 16 x C numbers on the way.
    table = coefs.float().movedim(3, 2).reshape(-1, coefs.shape[2])
    index = (4 * flat[:, :, None] + torch.arange(4, device=flat.device)).flatten(1)
    part = (share[:, :, None] * colour[:, None]).flatten(1)
    return F.embedding_bag(index, table, mode="sum", per_sample_weights=part)


def _corners(pixel: Annotated[Tensor, "R 2"], cells: Tensor, size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rows [R 2] and columns [R 2] of the four cells around each pixel, and their shares [R 4] in bilinear
    interpolation.

    `cells` are rows and columns, `size` height and width: [2], or [R 2] where they differ from pixel to
    pixel.
    """
    at = (pixel.float().flip(1) * (cells.float() / size.float()) - 0.5).clamp_min(0)
    at = torch.minimum(at, (cells - 1).float())
    low = torch.minimum(at.floor().long(), (cells - 2).clamp_min(0))
    high = torch.minimum(low + 1, cells - 1)
    part = at - low
    row, column = (torch.stack([low[:, axis], high[:, axis]], 1) for axis in (0, 1))
    y, x = (torch.stack([1 - part[:, axis], part[:, axis]], 1) for axis in (0, 1))
    return row, column, (y[:, :, None] * x[:, None, :]).flatten(1)


class Packed(NamedTuple):
    """Coefficients of V views, one after the other, stored small: F = scale (A (I - grey) + b) + centre."""

    coefs: Annotated[Tensor, "cells 4 P"]
    """float16, row by row of each view: A for red, green, blue, then b; channels beyond C are padding."""
    start: Annotated[Tensor, "V"]
    """int64 number of each view's first cell."""
    cells: Annotated[Tensor, "V 2"]
    """int64 rows and columns of cells."""
    size: Annotated[Tensor, "V 2"]
    """int64 height and width of the image in pixels."""
    scale: Annotated[Tensor, "V C"]
    centre: Annotated[Tensor, "V C"]


def apply_packed(
    packed: Packed,
    view: Annotated[Tensor, "R"],
    pixel: Annotated[Tensor, "R 2"],
    rgb: Annotated[Tensor, "R 3"],
    *,
    grey: float,
) -> Annotated[Tensor, "R C"]:
    """`apply` for pixels of several views at once, float32; all tensors on one device, `view` counts in
    `packed`.

    Makes R x 16 x P numbers on the way. Sums are of float32 numbers whatever TF32 says.
    """
    cells = packed.cells[view]
    row, column, share = _corners(pixel, cells, packed.size[view])
    index = (row[:, :, None] * cells[:, 1, None, None] + column[:, None, :]).flatten(1) + packed.start[
        view, None
    ]
    colour = torch.cat([rgb.float() - grey, torch.ones_like(rgb[:, :1], dtype=torch.float32)], 1)
    mixed = (packed.coefs[index].float() * (share[:, :, None] * colour[:, None, :])[..., None]).sum((1, 2))
    return mixed[:, : packed.scale.shape[1]] * packed.scale[view] + packed.centre[view]


def upsample(
    features: Annotated[Tensor, "C h w"],
    guide: Annotated[Tensor, "H W 3"],
    *,
    radius: int,
    eps: float,
    stride: int = 8,
) -> Annotated[Tensor, "H W C"]:
    """The whole filtered image, float32."""
    coefs = coefficients(features, guide, radius=radius, eps=eps, stride=stride)
    size = (guide.shape[0], guide.shape[1])
    colour = guide.permute(2, 0, 1).float()
    result = torch.empty(*size, features.shape[0], device=features.device)
    group = max(1, GROUP // (4 * size[0] * size[1]))
    for first in range(0, features.shape[0], group):
        part = coefs[:, :, first : first + group].permute(3, 2, 0, 1)
        dense = F.interpolate(part, size, mode="bilinear", align_corners=False)
        result[..., first : first + group] = ((dense[:3] * colour[:, None]).sum(0) + dense[3]).permute(
            1, 2, 0
        )
    return result


def _solve(
    features: Tensor, mean: Tensor, inverse: Tensor, moments: Tensor, colour: Tensor, operators: list[Tensor]
) -> Annotated[Tensor, "4 C s t"]:
    """A and b of a group of channels."""
    # cov(I, p) in every window; A = (cov(I, I) + eps)^-1 cov(I, p) and b = mean(p) - A mean(I) (He et al.,
    # Eq. 19 and 20).
    window_y, window_x, keep_y, keep_x = operators
    centre = features.mean((1, 2))[:, None, None]
    nodes = F.interpolate((features - centre)[None], moments.shape[1:], mode="bilinear", align_corners=False)[
        0
    ]
    sums = window_y @ ((moments[:, None] * nodes) @ window_x)
    covariance = sums[1:] - mean[:, None] * sums[0]
    slope = torch.stack([(inverse[i][:, None] * covariance).sum(0) for i in range(3)])
    offset = sums[0] - (slope * mean[:, None]).sum(0)
    result = keep_y @ (torch.cat([slope, offset[None]]) @ keep_x)
    result[3] += centre - (result[:3] * colour).sum(0)
    return result


def _statistics(pixels: Tensor, y: _Axis, x: _Axis, eps: float) -> tuple[Tensor, Tensor]:
    """Mean [3 c d] and regularised inverse covariance [3 3 c d] of the guide in every window, float64."""
    first, second = torch.triu_indices(3, 3, device=pixels.device)
    stack = torch.cat([pixels, pixels[first] * pixels[second]])
    means = (y.window @ y.hat) @ (stack @ (x.window @ x.hat).T)
    mean = means[:3]
    square = means[3:]
    covariance = square.new_empty(3, 3, *square.shape[1:])
    covariance[first, second] = square - mean[first] * mean[second]
    covariance[second, first] = covariance[first, second]
    variance = covariance.diagonal(dim1=0, dim2=1)
    variance.copy_(variance.clamp_min(0) + eps)
    return mean, torch.linalg.inv(covariance.permute(2, 3, 0, 1)).permute(2, 3, 0, 1)


def _axis(pixels: int, cells: int, radius: int, stride: int, fineness: float) -> _Axis:
    """The operators of one axis for `cells` features over `pixels`."""
    size = 2 * radius + 1
    spacing = max(1.0, size / fineness)
    factor = 2 * math.ceil((pixels / (cells * spacing) - 1) / 2) + 1
    nodes = min(pixels, cells * max(1, factor))
    stored = math.ceil(pixels / stride)
    centres = min(pixels, stored * math.ceil(pixels / (stored * spacing)))

    # Windows around the centres as shares of the axis, in nodes and in centres; then the least-squares fit of
    # the cells.
    hat = interpolation(nodes, pixels)
    middle = (torch.arange(centres).double() + 0.5) / centres
    reach = 0.5 * size / pixels
    window = _overlap(middle - reach, middle + reach, nodes)
    box = _overlap(middle - reach, middle + reach, centres)
    read = interpolation(stored, centres)
    fit = torch.linalg.solve(read @ read.T, read)
    return _Axis(
        hat=hat,
        window=window / (window @ hat.sum(1))[:, None],
        keep=fit @ (box / box.sum(1, keepdim=True)),
    )


def interpolation(cells: int, pixels: int) -> Annotated[Tensor, "cells pixels"]:
    """Weight of each cell at each pixel: bilinear interpolation as `F.interpolate` with align_corners=False
    does it.
    """
    at = ((torch.arange(pixels).double() + 0.5) * cells / pixels - 0.5).clamp(0, cells - 1)
    return (1 - (at - torch.arange(cells).double()[:, None]).abs()).clamp_min(0)


def _overlap(low: Tensor, high: Tensor, cells: int) -> Tensor:
    """Length that each interval [low, high] shares with each of `cells` equal cells of [0, 1]."""
    edge = torch.arange(cells + 1).double() / cells
    return (torch.minimum(high[:, None], edge[1:]) - torch.maximum(low[:, None], edge[:-1])).clamp_min(0)
