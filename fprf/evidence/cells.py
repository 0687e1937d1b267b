"""Style codes at the resolution of the feature maps, without clustering: what local AdaIN does where every cell is a style."""

from collections.abc import Mapping
from typing import Annotated

import torch
from torch import Tensor

from ..errors import DataError
from ..evaluation.flat import encoded
from ..style.dictionary import BLEND, StyleDictionary, blend_codes
from ..style.references import Encoders
from ..style.statistics import covariance, group_moments, moments
from ..training.loading import Trained

__all__ = ["CELL", "cell_dictionary", "cells"]

CELL = 8
"""Pixels across a cell: the stride of the bundled semantic encoder."""


def cells(height: int, width: int) -> Annotated[Tensor, "N"]:
    """Number of the cell that each pixel lies in, row by row, int64; what is left at the border joins the last whole cell."""
    rows, columns = (
        torch.arange(side).div(CELL, rounding_mode="floor").clamp_max(max(side // CELL, 1) - 1) for side in (height, width)
    )
    return (rows[:, None] * max(width // CELL, 1) + columns).flatten()


@torch.no_grad()
def cell_dictionary(
    images: Mapping[str, Annotated[Tensor, "H W 3"]], trained: Trained, encoders: Encoders, blend: float = BLEND
) -> StyleDictionary:
    """Of photographs by name: a code for every cell, with the statistics of its pixels. Raises DataError without semantics."""
    if encoders.semantic is None or encoders.basis is None:
        raise DataError("style cells: the scene has no semantics; train it with a semantic encoder")
    guided = trained.config.datamanager.guided
    parts = []
    for image in (each.to(encoders.device) for each in images.values()):
        label = cells(*image.shape[:2]).to(image.device)
        member = torch.nn.functional.one_hot(label).double()
        content, colour = encoded(image, encoders.content, guided), image.reshape(-1, 3)
        semantic = encoded(image, encoders.semantic, guided, encoders.basis)
        keys, _, share = group_moments(semantic, member)
        found = []
        for values in (content, colour):
            mean, spread, _ = group_moments(values, member)
            whole = moments(values, values.new_ones(len(values)))
            at = mean.new_full((len(mean),), blend)
            found += [x.float() for x in blend_codes(mean, spread, whole.mean, covariance(whole), at)]
        parts.append((keys.float(), share.float(), *found))
    keys, share, mean, spread, tint, tint_spread = (torch.cat(part).cpu() for part in zip(*parts, strict=True))
    count = torch.tensor([len(part[0]) for part in parts])
    return StyleDictionary(
        keys=keys,
        mean=mean,
        covariance=spread,
        share=share,
        reference=torch.arange(len(parts)).repeat_interleave(count),
        weight=torch.ones(len(keys)),
        names=tuple(images),
        blend=blend,
        colour_mean=tint,
        colour_covariance=tint_spread,
    )
