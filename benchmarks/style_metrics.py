"""Differences of pictures in style: structure, CIEDE2000, style distance and contrast, of images [H W 3] in [0,
1].

Structure is SSIM's second factor, of luminances that are first brought to one mean and deviation, because a
style may make a picture darker and flatter as a whole:

    structure = mean over windows of (2 σ_ab + K) / (σ_a² + σ_b² + K)

CIEDE2000 after Sharma, Wu and Dalal 2005, with k_L = k_C = k_H = 1 in float64; Lab is that of the illuminant
D65, with a lightness from 0 to 100. A difference of 1 is just visible, 10 is another shade, 50 another
colour.

Style distance: how far a picture's feature statistics are from its references', region by region.

Features of each layer are described in each region by mean and deviation (or, with `full`, by their
covariance), and two regions are compared by the Fréchet (2-Wasserstein) distance of the Gaussians:

    d² = |μ_a - μ_b|² + |σ_a - σ_b|²          per channel
    d² = |μ_a - μ_b|² + tr(C_a + C_b - 2 (C_a^½ C_b C_a^½)^½)                                      with covariances

Regions are averaged by their share of the content and divided by the same for the unstylised picture: 0 = the
reference's own statistics, 1 = no change. Layers count alike. Use an encoder that took no part in the
styling.

`matched_regions` finds regions that pictures share: clusters of the references' cells under a semantic
encoder; a cell of the content takes the region whose direction its own is most like. Both sides are centred
on their own mean.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from fprf.errors import DataError
from fprf.evaluation.metrics import image_metrics, mean_metrics
from fprf.interfaces import Encoder
from fprf.io.images import srgb_to_linear
from fprf.style.light import luma
from fprf.style.matching import unit
from fprf.style.statistics import covariance, kmeans, moments, symmetric_root

_INSIDE = 2
"""Pixels around one that must be of its region for it to lie inside."""


def mean_scores(
    pictures: Sequence[Annotated[Tensor, "H W 3"]], truth: Sequence[Annotated[Tensor, "H W 3"]]
) -> tuple[dict[str, float], Annotated[Tensor, "N"]]:
    """`image_metrics`, means over the views, and `delta_e`, the mean over all pixels; and that of each pixel
    of all views.
    """
    row = mean_metrics([image_metrics(a, b) for a, b in zip(pictures, truth, strict=True)])
    apart = torch.cat([delta_e(a, b).flatten() for a, b in zip(pictures, truth, strict=True)])
    return {**row, "delta_e": float(apart.mean())}, apart


_SIGMA = 1.5
_REACH = 5
"""Pixels from the middle of a window to its side: Wang's 11 x 11."""
_DEVIATION = 0.25
"""Both luminances get this deviation: about that of a photograph, for which K was chosen."""
_K = 0.03**2
_FLAT = 1e-3
"""Pictures that vary less (a quarter of an 8-bit step) have no structure to bring to a common deviation."""


def structure(a: Annotated[Tensor, "H W 3"], b: Annotated[Tensor, "H W 3"]) -> float:
    """In [-1, 1], 1 for pictures that differ by brightness and contrast alone; symmetric.

    Raises DataError for pictures of different sizes, or smaller than a window of 11 pixels.
    """
    if a.shape != b.shape or a.ndim != 3 or min(a.shape[:2]) <= 2 * _REACH:
        raise DataError(
            f"structure: pictures of shape {tuple(a.shape)} and {tuple(b.shape)}; both must be [H W 3] of one size, with "
            f"sides of at least {2 * _REACH + 1} pixels"
        )
    x = _standard(a)
    y = _standard(b)
    means = [_windows(each) for each in (x, y, x * x, y * y, x * y)]
    var_x = means[2] - means[0] ** 2
    var_y = means[3] - means[1] ** 2
    shared = means[4] - means[0] * means[1]
    return float(((2 * shared + _K) / (var_x + var_y + _K)).mean().clamp(-1, 1))


def _standard(image: Tensor) -> Annotated[Tensor, "1 1 H W"]:
    grey = luma(image.reshape(-1, 3).double()).reshape(1, 1, *image.shape[:2])
    centred = grey - grey.mean()
    spread = centred.square().mean().sqrt()
    return centred * (_DEVIATION / spread) if float(spread) > _FLAT else centred


def _windows(x: Annotated[Tensor, "1 1 H W"]) -> Tensor:
    """Gaussian means over the windows that lie wholly inside."""
    at = torch.arange(-_REACH, _REACH + 1, dtype=x.dtype, device=x.device)
    kernel = torch.exp(-at.square() / (2 * _SIGMA**2))
    kernel = kernel / kernel.sum()
    return F.conv2d(F.conv2d(x, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))


_TO_XYZ = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)
"""Linear sRGB to CIE XYZ (IEC 61966-2-1)."""
_POLE = 25.0**7
_EDGE = 6 / 29
"""Value below which Lab's cube root is a line."""


def delta_e(a: Annotated[Tensor, "... 3"], b: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "..."]:
    """Difference of sRGB colours in [0, 1], at least 0; symmetric."""
    return delta_e_2000(srgb_to_lab(a), srgb_to_lab(b))


def srgb_to_lab(rgb: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "... 3"]:
    """CIE Lab of sRGB colours in [0, 1]; white is the sum of the primaries, so greys have no hue."""
    matrix = torch.tensor(_TO_XYZ, dtype=torch.float64, device=rgb.device)
    xyz = srgb_to_linear(rgb.double()) @ matrix.T / matrix.sum(1)
    root = torch.where(xyz > _EDGE**3, xyz.clamp_min(1e-12) ** (1 / 3), xyz / (3 * _EDGE**2) + 4 / 29)
    x, y, z = root.unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def delta_e_2000(
    first: Annotated[Tensor, "... 3"], second: Annotated[Tensor, "... 3"]
) -> Annotated[Tensor, "..."]:
    """Difference of Lab colours."""
    light1, a1, b1 = first.double().unbind(-1)
    light2, a2, b2 = second.double().unbind(-1)
    chroma = (torch.hypot(a1, b1) + torch.hypot(a2, b2)) / 2
    stretch = 1.5 - 0.5 * _dulled(chroma)
    a1 = a1 * stretch
    a2 = a2 * stretch
    c1 = torch.hypot(a1, b1)
    c2 = torch.hypot(a2, b2)
    h1 = torch.atan2(b1, a1) % (2 * math.pi)
    h2 = torch.atan2(b2, a2) % (2 * math.pi)
    coloured = (c1 * c2) > 0
    apart = h2 - h1
    turn = torch.where(
        apart > math.pi, apart - 2 * math.pi, torch.where(apart < -math.pi, apart + 2 * math.pi, apart)
    )
    turn = torch.where(coloured, turn, 0.0)
    d_light = light2 - light1
    d_chroma = c2 - c1
    d_hue = 2 * (c1 * c2).sqrt() * torch.sin(turn / 2)

    light = (light1 + light2) / 2
    c = (c1 + c2) / 2
    middle = torch.where(apart.abs() > math.pi, (h1 + h2 + 2 * math.pi) / 2 % (2 * math.pi), (h1 + h2) / 2)
    hue = torch.where(coloured, middle, h1 + h2)
    weight = (
        1
        - 0.17 * torch.cos(hue - math.radians(30))
        + 0.24 * torch.cos(2 * hue)
        + 0.32 * torch.cos(3 * hue + math.radians(6))
        - 0.20 * torch.cos(4 * hue - math.radians(63))
    )
    s_light = 1 + 0.015 * (light - 50) ** 2 / (20 + (light - 50) ** 2).sqrt()
    s_chroma = 1 + 0.045 * c
    s_hue = 1 + 0.015 * c * weight
    blue = math.radians(30) * torch.exp(-(((torch.rad2deg(hue) - 275) / 25) ** 2))
    twist = -torch.sin(2 * blue) * 2 * _dulled(c)
    l = d_light / s_light
    k = d_chroma / s_chroma
    h = d_hue / s_hue
    return (l * l + k * k + h * h + twist * k * h).clamp_min(0).sqrt()


def _dulled(chroma: Tensor) -> Tensor:
    power = chroma**7
    return (power / (power + _POLE)).sqrt()


MIXED = -1
"""Label of cells that more than one region meets in."""
_CELLS = 8
"""A region needs so many cells of a layer on both sides: fewer say nothing of a style."""

Labelled = Sequence[tuple[Annotated[Tensor, "H W 3"], Annotated[Tensor, "G F"]]]
"""Pictures, each with the region of its pixels (or of cells of any size); the same ids mean the same on all
sides.
"""


def whole_cells(regions: Annotated[Tensor, "H W"], size: tuple[int, int]) -> Annotated[Tensor, "h w"]:
    """The region of every cell of a grid of `size` (height, width) over the image; MIXED where there are
    several.
    """
    pixels = regions[None, None].double()
    highest = F.adaptive_max_pool2d(pixels, size)
    lowest = -F.adaptive_max_pool2d(-pixels, size)
    return torch.where(highest == lowest, highest, MIXED)[0, 0].long()


class RegionStatistics(NamedTuple):
    """One region in one layer, float64."""

    cells: int
    mean: Annotated[Tensor, "C"]
    covariance: Annotated[Tensor, "C C"]


@torch.no_grad()
def region_statistics(encoder: Encoder, pictures: Labelled) -> dict[int, RegionStatistics]:
    """Statistics of every region over all pictures together; borders between regions are left out.

    Raises DataError where no picture has a cell that lies wholly in one region.
    """
    features = []
    labels = []
    for image, regions in pictures:
        maps: Tensor = encoder(image.permute(2, 0, 1)[None])[0]
        features.append(maps.flatten(1).T)
        labels.append(whole_cells(regions, (maps.shape[1], maps.shape[2])).flatten())
    cells = torch.cat(features)
    label = torch.cat(labels)
    kinds = sorted(set(label.tolist()) - {MIXED})
    if not kinds:
        raise DataError("style distance: no cell lies wholly in one region; use larger pictures or regions")
    return {kind: _described(cells[label == kind]) for kind in kinds}


class Contrast(NamedTuple):
    """Contrast of luma inside of a region, away from its borders."""

    pixels: int
    gradient: float
    """Mean absolute difference between neighbouring pixels, along rows and columns."""
    black: float
    """1 % quantile."""
    white: float
    """99 % quantile."""

    @property
    def range(self) -> float:
        """From black to white."""
        return self.white - self.black


def region_contrasts(pictures: Labelled) -> dict[int, Contrast]:
    """Contrast of every region over all pictures together, of pixels no nearer than two to another region."""
    found: dict[int, list[tuple[Tensor, Tensor]]] = {}
    for image, regions in pictures:
        near = F.interpolate(regions[None, None].double(), image.shape[:2], mode="nearest-exact")
        padded = F.pad(near, (_INSIDE,) * 4, mode="replicate")
        side = 2 * _INSIDE + 1
        inside = (F.max_pool2d(padded, side, 1) == -F.max_pool2d(-padded, side, 1))[0, 0]
        light = luma(image.flatten(0, 1)).view(image.shape[:2])
        # Forward differences; the last row and column repeat themselves and are left out.
        steps = (light[:-1, 1:] - light[:-1, :-1]).abs() + (light[1:, :-1] - light[:-1, :-1]).abs()
        inside = inside[:-1, :-1]
        kinds = near[0, 0, :-1, :-1].long()
        light = light[:-1, :-1]
        for kind in sorted(set(kinds[inside].tolist())):
            here = inside & (kinds == kind)
            found.setdefault(kind, []).append((light[here], steps[here] / 2))
    contrasts = {}
    for kind, parts in sorted(found.items()):
        values, differences = (torch.cat(each).double().cpu().numpy() for each in zip(*parts, strict=True))
        black, white = np.quantile(values, (0.01, 0.99)).tolist()
        contrasts[kind] = Contrast(len(values), float(differences.mean()), black, white)
    return contrasts


def contrast_kept(
    plain: Mapping[int, Contrast], styled: Mapping[int, Contrast], style: Mapping[int, Contrast]
) -> dict[str, float | None]:
    """Shares of the plain picture's mean gradient (`gradient_kept`) and range of luma (`range_kept`) that are
    left.

    Means over the regions whose range is no less in the style than in the plain picture, by their pixels;
    None where there is no such region.
    """
    kept = [
        (each, styled[k])
        for k, each in plain.items()
        if k in style and style[k].range >= each.range > 0 < each.gradient
    ]
    pixels = sum(each.pixels for each, _ in kept)
    if not pixels:
        return {"gradient_kept": None, "range_kept": None}
    return {
        "gradient_kept": math.fsum(a.pixels * b.gradient / a.gradient for a, b in kept) / pixels,
        "range_kept": math.fsum(a.pixels * b.range / a.range for a, b in kept) / pixels,
    }


def gaussian_distance(a: RegionStatistics, b: RegionStatistics, *, full: bool = False) -> float:
    """The 2-Wasserstein distance of two regions: of means and deviations, or with `full` of means and
    covariances.
    """
    apart = float((a.mean - b.mean).square().sum())
    if not full:
        deviations = [each.covariance.diagonal().clamp_min(0).sqrt() for each in (a, b)]
        return math.sqrt(apart + float((deviations[0] - deviations[1]).square().sum()))
    cross = torch.linalg.svdvals(symmetric_root(a.covariance) @ symmetric_root(b.covariance)).sum()
    spread = float(a.covariance.trace() + b.covariance.trace() - 2 * cross)
    return math.sqrt(apart + max(0.0, spread))


def relative_distance(
    plain: Mapping[int, RegionStatistics],
    styled: Mapping[int, RegionStatistics],
    style: Mapping[int, RegionStatistics],
    *,
    full: bool = False,
) -> float | None:
    """Distance to the style over that of the unstylised picture, regions by their share of it; one layer.

    None where no region has enough cells on all sides, or the unstylised picture has the style's statistics
    already.
    """
    regions = [
        r
        for r, before in plain.items()
        if r in styled and r in style and min(before.cells, styled[r].cells, style[r].cells) >= _CELLS
    ]
    before = sum(plain[r].cells * gaussian_distance(plain[r], style[r], full=full) for r in regions)
    after = sum(plain[r].cells * gaussian_distance(styled[r], style[r], full=full) for r in regions)
    return after / before if before > 0 else None


def style_distances(
    judges: Mapping[str, Encoder],
    plain: Labelled,
    styled: Mapping[str, Labelled],
    style: Labelled,
    *,
    full: bool = False,
) -> dict[str, dict[str, float | None]]:
    """For every method of `styled`: the relative distance by judge (a layer each), and their mean as `mean`.

    A judge for whom nothing can be compared is None and left out of the mean.
    """
    rows: dict[str, dict[str, float | None]] = {name: {} for name in styled}
    for judge, encoder in judges.items():
        before = region_statistics(encoder, plain)
        target = region_statistics(encoder, style)
        for name, pictures in styled.items():
            rows[name][judge] = relative_distance(
                before, region_statistics(encoder, pictures), target, full=full
            )
    for row in rows.values():
        known = [value for value in row.values() if value is not None]
        row["mean"] = math.fsum(known) / len(known) if known else None
    return rows


def _described(cells: Annotated[Tensor, "N C"]) -> RegionStatistics:
    statistics = moments(cells, torch.ones(len(cells)))
    return RegionStatistics(len(cells), statistics.mean, covariance(statistics))


@torch.no_grad()
def matched_regions(
    encoder: Encoder,
    contents: Sequence[Annotated[Tensor, "H W 3"]],
    styles: Sequence[Annotated[Tensor, "G F 3"]],
    *,
    regions: int,
    seed: int,
) -> tuple[list[Annotated[Tensor, "h w"]], list[Annotated[Tensor, "g f"]]]:
    """Region ids of the encoder's cells, in the contents and in the styles; at most `regions` of them."""
    here, there = (
        [encoder(image.permute(2, 0, 1)[None])[0].float() for image in side] for side in (contents, styles)
    )
    clusters = kmeans(_directions(there), regions, seed=seed)
    like = _directions(here) @ torch.nn.functional.normalize(clusters.centres, dim=1).T
    return _maps(like.argmax(1), here), _maps(clusters.label, there)


def _directions(maps: Sequence[Annotated[Tensor, "C h w"]]) -> Annotated[Tensor, "N C"]:
    cells = torch.cat([each.flatten(1).T for each in maps])
    return unit(cells, cells.mean(0))


def _maps(
    label: Annotated[Tensor, "N"], like: Sequence[Annotated[Tensor, "C h w"]]
) -> list[Annotated[Tensor, "h w"]]:
    sizes = [each.shape[1:] for each in like]
    parts = torch.split_with_sizes(label, [height * width for height, width in sizes])
    return [part.reshape(size) for part, size in zip(parts, sizes, strict=True)]
