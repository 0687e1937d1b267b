"""How near pictures come to the truth: overall, by class, and what no map of colours can exceed."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
from torch import Tensor

from ..evaluation.colour_difference import delta_e
from ..evaluation.metrics import image_metrics, mean_metrics
from ..town.classes import CLASSES

__all__ = ["Row", "best_class_maps", "mean_rows", "score"]

Row = dict[str, float | None]
Picture = Annotated[Tensor, "H W 3"]
_RIDGE = 1e-4
"""Variance added before a class's colours are inverted: a class of one colour is only moved."""


def score(
    pictures: Sequence[Picture], truth: Sequence[Picture], labels: Sequence[Annotated[Tensor, "H W"]]
) -> tuple[Row, dict[str, float]]:
    """`psnr`, `ssim` (means over the views) and `delta_e` (over all pixels); and the latter by class."""
    row: Row = dict(mean_metrics([image_metrics(a, b) for a, b in zip(pictures, truth, strict=True)]))
    apart = torch.cat([delta_e(a, b).flatten() for a, b in zip(pictures, truth, strict=True)])
    kinds = torch.cat([each.flatten() for each in labels])
    row["delta_e"] = float(apart.mean())
    return row, {CLASSES[k]: float(apart[kinds == k].mean()) for k in sorted(set(kinds.tolist()))}


def best_class_maps(
    plain: Sequence[Picture], truth: Sequence[Picture], labels: Sequence[Annotated[Tensor, "H W"]]
) -> list[Picture]:
    """The plain pictures after the affine map of colours of each true class that is nearest to the truth (least squares).

    It knows the truth: a bound on what moving the colours of classes as wholes can reach, with this reconstruction.
    """
    here, there = (torch.cat([image.reshape(-1, 3) for image in side]).double() for side in (plain, truth))
    kinds = torch.cat([each.flatten() for each in labels])
    moved = torch.empty_like(here)
    for kind in set(kinds.tolist()):
        inside = kinds == kind
        a, b = here[inside], there[inside]
        middle, target = a.mean(0), b.mean(0)
        spread = (a - middle).T @ (a - middle) / len(a) + _RIDGE * torch.eye(3, dtype=torch.float64)
        matrix = torch.linalg.solve(spread, (a - middle).T @ (b - target) / len(a))
        moved[inside] = (a - middle) @ matrix + target
    parts = torch.split(moved.clamp(0, 1).float(), [image.shape[0] * image.shape[1] for image in plain])
    return [part.reshape(image.shape) for part, image in zip(parts, plain, strict=True)]


def mean_rows(tables: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
    """Mean of every figure over tables with the same methods; what is None somewhere is left out there."""
    found: dict[str, Row] = {}
    for method in tables[0]:
        found[method] = {}
        for key in tables[0][method]:
            values = [value for table in tables if (value := table[method][key]) is not None]
            found[method][key] = math.fsum(values) / len(values) if values else None
    return found
