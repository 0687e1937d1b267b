"""How well an encoder tells what a thing is: does a cell of one image find its like in another one?

Matching rate of a pair of images: features are centred over both; a content cell is labelled by the region to whose three
nearest style cells it is most similar (mean cosine); the rate is the share of right labels, region by region, averaged.

Class match across palettes: a class is the mean of its cells in one light; a cell of another light takes the most similar
class (cosine). Each side is centred on its own mean, as the stylizers do it.

Only cells that lie wholly inside of one region count: at a border both labels would be right.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import DataError
from ..interfaces import Encoder
from .triplets import Triplet

__all__ = ["MIXED", "class_match", "matching_rate", "palette_match", "semantic_matching", "shared_regions", "whole_cells"]

MIXED = -1
"""Label of cells that more than one region meets in."""

_NEAREST = 3
_COARSE = 16
"""Pixels a cell, on the grid that decides which regions count: the same ones for every encoder."""
_SHARE = 0.01
"""A region counts where it fills this share of both images."""
_FINEST = 8
"""Features finer than this many pixels a cell are averaged: a comparison of all cells is quadratic."""


def whole_cells(regions: Annotated[Tensor, "H W"], size: tuple[int, int]) -> Annotated[Tensor, "h w"]:
    """The region of every cell of a grid of `size` (height, width) over the image; MIXED where there are several."""
    pixels = regions[None, None].double()
    highest, lowest = F.adaptive_max_pool2d(pixels, size), -F.adaptive_max_pool2d(-pixels, size)
    return torch.where(highest == lowest, highest, MIXED)[0, 0].long()


def matching_rate(
    content: Annotated[Tensor, "N C"],
    style: Annotated[Tensor, "M C"],
    content_labels: Annotated[Tensor, "N"],
    style_labels: Annotated[Tensor, "M"],
    regions: Sequence[int],
) -> float:
    """Mean hit rate over the regions, in [0, 1]. Chance: 1 / len(regions). Cells of other labels only count as centre.

    Raises DataError where a region has no cell on one of the sides.
    """
    for region in regions:
        if not (bool((content_labels == region).any()) and bool((style_labels == region).any())):
            raise DataError(f"semantic matching: no cell of region {region} in one of the images; leave the region out")
    centre = torch.cat([content, style]).mean(0)
    near, far = F.normalize(content - centre, dim=1), F.normalize(style - centre, dim=1)
    scores = []
    for region in regions:
        like = near @ far[style_labels == region].T
        scores.append(like.topk(min(_NEAREST, like.shape[1]), dim=1).values.mean(1))
    found = torch.stack(scores, 1).argmax(1)
    hits = [float((found[content_labels == region] == place).double().mean()) for place, region in enumerate(regions)]
    return math.fsum(hits) / len(hits)


def shared_regions(triplet: Triplet) -> list[int]:
    """Regions that fill at least 1 % of both images with whole cells of 16 pixels."""
    shares = []
    for regions, image in ((triplet.content_regions, triplet.content), (triplet.style_regions, triplet.style)):
        cells = whole_cells(regions, (image.shape[0] // _COARSE, image.shape[1] // _COARSE))
        shares.append(
            {r for r in set(cells.flatten().tolist()) if r != MIXED and float((cells == r).double().mean()) >= _SHARE}
        )
    return sorted(shares[0] & shares[1])


@torch.no_grad()
def semantic_matching(encoder: Encoder, triplets: Sequence[Triplet]) -> dict[str, float | int | dict[str, float]]:
    """`matching` (mean rate), `chance`, `triplets` (those with at least two shared regions), `per_triplet` by name.

    Raises DataError where no triplet has two regions to tell apart.
    """
    rates, chances = {}, []
    for triplet in triplets:
        regions = shared_regions(triplet)
        if len(regions) < 2:
            continue
        content, style = (_features(encoder, image) for image in (triplet.content, triplet.style))
        rates[triplet.name] = matching_rate(
            content.flatten(1).T,
            style.flatten(1).T,
            whole_cells(triplet.content_regions, (content.shape[1], content.shape[2])).flatten(),
            whole_cells(triplet.style_regions, (style.shape[1], style.shape[2])).flatten(),
            regions,
        )
        chances.append(1 / len(regions))
    if not rates:
        raise DataError("semantic matching: no pair of images shares two regions; there is nothing to tell apart")
    return {
        "matching": math.fsum(rates.values()) / len(rates),
        "chance": math.fsum(chances) / len(chances),
        "triplets": len(rates),
        "per_triplet": rates,
    }


def class_match(
    features: Annotated[Tensor, "N C"],
    labels: Annotated[Tensor, "N"],
    known: Annotated[Tensor, "M C"],
    known_labels: Annotated[Tensor, "M"],
) -> tuple[float, dict[int, float]]:
    """Share of cells whose nearest class centroid of the known side is their own class: overall, and class by class.

    MIXED cells, and cells of classes that the known side lacks, don't count. Raises DataError where none is left.
    """
    classes = sorted(set(known_labels.tolist()) - {MIXED})
    inside = torch.isin(labels, torch.tensor(classes, dtype=labels.dtype, device=labels.device))
    if not bool(inside.any()):
        raise DataError("class match: no cell of a class that both sides show")
    known = known - known[known_labels != MIXED].mean(0)
    centroids = torch.stack([known[known_labels == c].mean(0) for c in classes])
    here = features[inside] - features[inside].mean(0)
    nearest = (F.normalize(here, dim=1) @ F.normalize(centroids, dim=1).T).argmax(1)
    right = torch.tensor(classes, device=labels.device)[nearest] == labels[inside]
    kinds = {c: float(right[labels[inside] == c].double().mean()) for c in classes if bool((labels[inside] == c).any())}
    return float(right.double().mean()), kinds


def palette_match(
    cells: Mapping[str, tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N"]]], known: str
) -> dict[str, float | dict[str, float]]:
    """`class_match` of every palette but `known`, whose centroids are used: `match` and `class_mean` over the palettes,
    `per_palette`, and `itself`, that of the known palette: what the classes' overlap alone costs.
    """
    rates, means = {}, []
    for name, (features, labels) in cells.items():
        if name != known:
            rates[name], kinds = class_match(features, labels, *cells[known])
            means.append(math.fsum(kinds.values()) / len(kinds))
    if not rates:
        raise DataError(f"class match: {known!r} is the only palette; render at least one other to compare with")
    return {
        "match": math.fsum(rates.values()) / len(rates),
        "class_mean": math.fsum(means) / len(means),
        "itself": class_match(*cells[known], *cells[known])[0],
        "per_palette": rates,
    }


def _features(encoder: Encoder, image: Annotated[Tensor, "H W 3"]) -> Annotated[Tensor, "C h w"]:
    found: Tensor = encoder(image.permute(2, 0, 1)[None]).float()
    height, width = (min(n, max(1, side // _FINEST)) for n, side in zip(found.shape[-2:], image.shape[:2], strict=True))
    return F.adaptive_avg_pool2d(found, (height, width))[0]
