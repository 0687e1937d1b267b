"""How near pictures come to the truth: overall, by class, and what no map of colours can exceed."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
from torch import Tensor

from ..evaluation.colour_difference import delta_e
from ..evaluation.metrics import image_metrics, mean_metrics
from ..style.transport import monge
from ..town.surface import CLASSES

__all__ = ["Labelled", "Row", "best_class_maps", "mean_rows", "score", "true_class_maps"]

Row = dict[str, float | None]
Picture = Annotated[Tensor, "H W 3"]
Labelled = Sequence[tuple[Picture, Annotated[Tensor, "H W"]]]
"""Pictures with the true class of every pixel."""
_RIDGE = 1e-4
"""Variance added before a class's colours are inverted: a class of one colour is only moved."""
_GAIN = 3.0
"""No direction of colour is amplified more, as in `style.colours`."""


def score(
    pictures: Sequence[Picture], truth: Sequence[Picture], labels: Sequence[Annotated[Tensor, "H W"]]
) -> tuple[Row, dict[str, float]]:
    """`psnr`, `ssim` (means over the views) and `delta_e` (over all pixels); and the latter by class."""
    row: Row = dict(mean_metrics([image_metrics(a, b) for a, b in zip(pictures, truth, strict=True)]))
    apart = torch.cat([delta_e(a, b).flatten() for a, b in zip(pictures, truth, strict=True)])
    kinds = torch.cat([each.flatten() for each in labels])
    row["delta_e"] = float(apart.mean())
    return row, {CLASSES[k]: float(apart[kinds == k].mean()) for k in sorted(set(kinds.tolist()))}


def best_class_maps(plain: Labelled, truth: Sequence[Picture]) -> list[Picture]:
    """The plain pictures after the affine map of colours of each true class that is nearest to the truth (least squares).

    It knows the truth: a bound on what moving the colours of classes as wholes can reach, with this reconstruction.
    """
    here, kinds = _flat(plain)
    there = torch.cat([image.reshape(-1, 3) for image in truth]).double()
    moved = torch.empty_like(here)
    for kind in set(kinds.tolist()):
        inside = kinds == kind
        a, b = here[inside], there[inside]
        middle, target = a.mean(0), b.mean(0)
        spread = (a - middle).T @ (a - middle) / len(a) + _RIDGE * torch.eye(3, dtype=torch.float64)
        matrix = torch.linalg.solve(spread, (a - middle).T @ (b - target) / len(a))
        moved[inside] = (a - middle) @ matrix + target
    return _pictures(moved, plain)


def true_class_maps(plain: Labelled, references: Labelled) -> list[Picture]:
    """The plain pictures with the colours of each true class carried to those of the same class in the references.

    What perfect matching would give. Classes that no reference shows take all colours of the references.
    """
    here, kinds = _flat(plain)
    there, known = _flat(references)
    floor = _RIDGE * torch.eye(3, dtype=torch.float64)
    moved = torch.empty_like(here)
    for kind in set(kinds.tolist()):
        a = here[kinds == kind]
        b = there[known == kind] if bool((known == kind).any()) else there
        spread, wide = (torch.cov(x.T, correction=0).reshape(3, 3) + floor for x in (a, b))
        moved[kinds == kind] = (a - a.mean(0)) @ monge(spread[None], wide[None], gain=_GAIN)[0] + b.mean(0)
    return _pictures(moved, plain)


def mean_rows(tables: Sequence[Mapping[str, Row]]) -> dict[str, Row]:
    """Mean of every figure over tables with the same methods; what is None somewhere is left out there."""
    found: dict[str, Row] = {}
    for method in tables[0]:
        found[method] = {}
        for key in tables[0][method]:
            values = [value for table in tables if (value := table[method][key]) is not None]
            found[method][key] = math.fsum(values) / len(values) if values else None
    return found


def _flat(pictures: Labelled) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N"]]:
    colours = torch.cat([image.reshape(-1, 3) for image, _ in pictures]).double()
    return colours, torch.cat([labels.flatten() for _, labels in pictures])


def _pictures(colours: Annotated[Tensor, "N 3"], like: Labelled) -> list[Picture]:
    parts = torch.split(colours.clamp(0, 1).float(), [image.shape[0] * image.shape[1] for image, _ in like])
    return [part.reshape(image.shape) for part, (image, _) in zip(parts, like, strict=True)]
