"""Style distance: how far a picture's feature statistics are from its references', region by region.

Features of each layer are described in each region by mean and deviation (or, with `full`, by their covariance), and two
regions are compared by the Fréchet (2-Wasserstein) distance of the Gaussians:

    d² = |μ_a - μ_b|² + |σ_a - σ_b|²          per channel
    d² = |μ_a - μ_b|² + tr(C_a + C_b - 2 (C_a^½ C_b C_a^½)^½)                                      with covariances

Regions are averaged by their share of the content and divided by the same for the unstylised picture: 0 = the reference's own
statistics, 1 = no change. Layers count alike. Use an encoder that took no part in the styling.

`matched_regions` finds regions that pictures share: clusters of the references' cells under a semantic encoder; a cell of the
content takes the region whose direction its own is most like. Both sides are centred on their own mean.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError
from ..interfaces import Encoder
from ..style.clusters import kmeans
from ..style.matching import unit
from ..style.statistics import covariance, moments, symmetric_root

__all__ = [
    "MIXED",
    "RegionStatistics",
    "gaussian_distance",
    "matched_regions",
    "region_statistics",
    "relative_distance",
    "style_distances",
    "whole_cells",
]


MIXED = -1
"""Label of cells that more than one region meets in."""
_CELLS = 8
"""A region needs so many cells of a layer on both sides: fewer say nothing of a style."""

Labelled = Sequence[tuple[Annotated[Tensor, "H W 3"], Annotated[Tensor, "G F"]]]
"""Pictures, each with the region of its pixels (or of cells of any size); the same ids mean the same on all sides."""


def whole_cells(regions: Annotated[Tensor, "H W"], size: tuple[int, int]) -> Annotated[Tensor, "h w"]:
    """The region of every cell of a grid of `size` (height, width) over the image; MIXED where there are several."""
    pixels = regions[None, None].double()
    highest, lowest = F.adaptive_max_pool2d(pixels, size), -F.adaptive_max_pool2d(-pixels, size)
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
    features, labels = [], []
    for image, regions in pictures:
        maps: Tensor = encoder(image.permute(2, 0, 1)[None])[0]
        features.append(maps.flatten(1).T)
        labels.append(whole_cells(regions, (maps.shape[1], maps.shape[2])).flatten())
    cells, label = torch.cat(features), torch.cat(labels)
    kinds = sorted(set(label.tolist()) - {MIXED})
    if not kinds:
        raise DataError("style distance: no cell lies wholly in one region; use larger pictures or regions")
    return {kind: _described(cells[label == kind]) for kind in kinds}


def gaussian_distance(a: RegionStatistics, b: RegionStatistics, *, full: bool = False) -> float:
    """The 2-Wasserstein distance of two regions: of means and deviations, or with `full` of means and covariances."""
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

    None where no region has enough cells on all sides, or the unstylised picture has the style's statistics already.
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
    judges: Mapping[str, Encoder], plain: Labelled, styled: Mapping[str, Labelled], style: Labelled, *, full: bool = False
) -> dict[str, dict[str, float | None]]:
    """For every method of `styled`: the relative distance by judge (a layer each), and their mean as `mean`.

    A judge for whom nothing can be compared is None and left out of the mean.
    """
    rows: dict[str, dict[str, float | None]] = {name: {} for name in styled}
    for judge, encoder in judges.items():
        before, target = region_statistics(encoder, plain), region_statistics(encoder, style)
        for name, pictures in styled.items():
            rows[name][judge] = relative_distance(before, region_statistics(encoder, pictures), target, full=full)
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
    here, there = ([encoder(image.permute(2, 0, 1)[None])[0].float() for image in side] for side in (contents, styles))
    clusters = kmeans(_directions(there), regions, seed=seed)
    like = _directions(here) @ torch.nn.functional.normalize(clusters.centres, dim=1).T
    return _maps(like.argmax(1), here), _maps(clusters.label, there)


def _directions(maps: Sequence[Annotated[Tensor, "C h w"]]) -> Annotated[Tensor, "N C"]:
    cells = torch.cat([each.flatten(1).T for each in maps])
    return unit(cells, cells.mean(0))


def _maps(label: Annotated[Tensor, "N"], like: Sequence[Annotated[Tensor, "C h w"]]) -> list[Annotated[Tensor, "h w"]]:
    sizes = [each.shape[1:] for each in like]
    parts = torch.split_with_sizes(label, [height * width for height, width in sizes])
    return [part.reshape(size) for part, size in zip(parts, sizes, strict=True)]
