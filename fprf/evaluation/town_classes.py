"""Cells of the town with their true classes, in every light: the same streets, so that only the palette differs."""

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from ..interfaces import Encoder
from ..town.layout import build_town
from ..town.palettes import palette
from ..town.render import colours, geometry, walk
from .semantic_matching import whole_cells

__all__ = ["town_cells"]


@torch.no_grad()
def town_cells(
    encoder: Encoder, palettes: Sequence[str], *, seeds: Sequence[int], views: int, size: tuple[int, int]
) -> dict[str, tuple[Annotated[Tensor, "N C"], Annotated[Tensor, "N"]]]:
    """Features and class ids (MIXED at borders) of all cells, by palette; `size` is (width, height) of a view.

    Raises DataError for a palette that does not exist.
    """
    looks = {name: palette(name) for name in palettes}
    features: dict[str, list[Tensor]] = {name: [] for name in looks}
    labels: list[Tensor] = []
    for seed in seeds:
        town = build_town(seed)
        for view in walk(seed=seed, views=views, width=size[0], height=size[1]):
            kinds = torch.from_numpy(geometry(town, view)[1].astype("int64"))
            for name, look in looks.items():
                image = torch.from_numpy(colours(town, view, look, 1)).permute(2, 0, 1)[None].clamp(0, 1)
                found: Tensor = encoder(image).float()[0]
                features[name].append(found.flatten(1).T)
            labels.append(whole_cells(kinds, (found.shape[1], found.shape[2])).flatten())
    return {name: (torch.cat(parts), torch.cat(labels)) for name, parts in features.items()}
