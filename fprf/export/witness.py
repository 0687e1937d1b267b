"""Which views see a point, and how well."""

import math
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..rendering.cameras import project
from .sights import Sights, gaps

__all__ = ["Witnesses", "alone", "expected_presence", "witnesses"]

_DECAY = math.log(9)
"""Extinctions of a uniform medium over the distance in which a ray meets the middle 80 % of its light."""
_GRAZING = 1e-3
"""Smallest cosine: a view that sees a surface from its edge still says more than none."""


class Witnesses(NamedTuple):
    """Of N points the K views that see each best."""

    view: Annotated[Tensor, "N K"]
    """int64 index among the sights, the best first."""
    weight: Annotated[Tensor, "N K"]
    """1 for the best, less for the others, 0 for views that do not see the point; float64."""


def alone(view: Annotated[Tensor, "N"]) -> Witnesses:
    """One view a point."""
    return Witnesses(view[:, None], torch.ones(len(view), 1, dtype=torch.float64))


def witnesses(
    sights: Sights,
    point: Annotated[Tensor, "N 3"],
    normal: Annotated[Tensor, "N 3"],
    near: Annotated[Tensor, "N"] | float,
    count: int = 1,
) -> Witnesses:
    """The finest and straightest of the views that see each point; where none does, the one that misses it least.

    A view sees what lies within 2 `near` of its surface, in world units. A view counts as many times as it has pixels on
    the surface: cosine / distance^2.
    """
    count = min(count, len(sights.depth))
    best = torch.full((len(point), count), -torch.inf, dtype=torch.float64)
    found = torch.zeros(len(point), count, dtype=torch.int64)
    for view in range(len(sights.depth)):
        gap, distance = gaps(sights, view, point)
        way = (sights.cameras.pose[view, :, 3] - point) / distance[:, None]
        facing = (way * normal.double()).sum(-1).clamp_min(_GRAZING)
        # Both kinds of score in one: positive where it is seen, negative where not.
        missed = torch.nan_to_num(gap.abs(), nan=1e18, posinf=1e17)
        score = torch.where(missed <= 2 * near, facing / distance.square(), -missed)
        scores = torch.cat([best, score[:, None]], 1)
        views = torch.cat([found, torch.full((len(point), 1), view)], 1)
        best, order = scores.topk(count, 1)
        found = views.gather(1, order)
    weight = (best / best[:, :1].clamp_min(1e-300)).clamp_min(0)
    weight[:, 0] = 1
    return Witnesses(found, weight)


def expected_presence(
    sights: Sights, point: Annotated[Tensor, "N 3"], seen: Witnesses, tolerance: float
) -> Annotated[Tensor, "N"]:
    """How much light comes from within `tolerance` of a point's distance where it lies in a surface as thick as its views see.

    1 for sharp surfaces. A surface that training has left thick, as far ones in forward-facing captures are, has only a part of
    its light there; between two surfaces, where nothing is, less light comes than from either. In (0, 1], float32.
    """
    total, weight = torch.zeros(len(point)), torch.zeros(len(point))
    if not sights.thickness:
        return torch.ones(len(point))
    for view, thickness in enumerate(sights.thickness):
        row, rank = ((seen.view == view) & (seen.weight > 0)).nonzero().unbind(1)
        pixel, _ = project(sights.cameras, torch.full((len(row),), view, dtype=torch.int64), point[row])
        height, width = thickness.shape
        pixel = torch.nan_to_num(pixel)
        x, y = pixel[:, 0].long().clamp(0, width - 1), pixel[:, 1].long().clamp(0, height - 1)
        light = -torch.expm1(-_DECAY * 2 * tolerance / thickness[y, x].clamp_min(1e-6))
        share = seen.weight[row, rank].float()
        total.index_add_(0, row, light * share)
        weight.index_add_(0, row, share)
    return torch.where(weight > 0, total / weight.clamp_min(1e-10), 1.0)
