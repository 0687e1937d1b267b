"""Which views see a point, and how well."""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from .sights import Sights, gaps

__all__ = ["Witnesses", "alone", "witnesses"]

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
