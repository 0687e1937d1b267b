"""Regions that pictures share, where nobody painted them: clusters of what a semantic encoder sees, found in both.

The regions of the references are clusters of their cells; a cell of the content takes the region whose direction its own is
most like. Both sides are centred on their own mean, as the stylizers do it, but the encoder should be another one: a judge that
sees with the eyes of the judged finds every match right.
"""

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from ..interfaces import Encoder
from ..style.clusters import kmeans
from ..style.matching import unit

__all__ = ["matched_regions"]


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
    found = kmeans(_directions(there), regions, seed=seed)
    like = _directions(here) @ torch.nn.functional.normalize(found.centres, dim=1).T
    return _maps(like.argmax(1), here), _maps(found.label, there)


def _directions(maps: Sequence[Annotated[Tensor, "C h w"]]) -> Annotated[Tensor, "N C"]:
    cells = torch.cat([each.flatten(1).T for each in maps])
    return unit(cells, cells.mean(0))


def _maps(label: Annotated[Tensor, "N"], like: Sequence[Annotated[Tensor, "C h w"]]) -> list[Annotated[Tensor, "h w"]]:
    sizes = [each.shape[1:] for each in like]
    parts = torch.split_with_sizes(label, [height * width for height, width in sizes])
    return [part.reshape(size) for part, size in zip(parts, sizes, strict=True)]
