"""Coverage of views by the training cameras of a capture: the choice of views that are worth showing.

A view is worth showing where several training cameras have seen the same from about the same direction.
"""

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor

from .cameras import Cameras, project, rays_through
from .space import Space

__all__ = ["coverage", "well_covered"]

_GRID = (4, 3)
"""Pixels of a view that are looked through, across and down."""
_HALF = 4
"""Cameras that see a point at which half of what more of them could add is reached."""
_ANGLE = 0.7
"""A camera counts where the cosine between its ray to the point and the view's is larger."""
_MOST = 256
"""Views, and training cameras, that are looked at; of more, so many at equal steps."""
_CHUNK = 16
"""Views at a time."""


def well_covered(cameras: Cameras, train: Sequence[int], space: Space, most: int) -> list[int]:
    """At most `most` of the views, in their order: all where there are no more, else well-covered ones, spread evenly."""
    if len(cameras) <= most:
        return list(range(len(cameras)))
    views, score = _thinned(range(len(cameras)), max(_MOST, most)), coverage(cameras, train, space)
    covered = score[views].argsort(descending=True, stable=True)[: max(most, len(views) // 2)].sort().values.tolist()
    return [views[covered[k * len(covered) // most]] for k in range(most)]


def coverage(cameras: Cameras, train: Sequence[int], space: Space) -> Annotated[Tensor, "V"]:
    """Coverage of each view: n / (n + 4) for n training cameras that see the same from about its direction, in [0, 1).

    What a view shows is not known from cameras alone: it is looked at half as far, as far and twice as far as the scene
    commonly lies. Of more than 256 views the others have the score 0.
    """
    far = 2 * space.near if space.kind == "ndc" else 1 / space.scale
    distances = torch.tensor([0.5 * far, far, 2 * far], dtype=torch.float64)
    centres = [(torch.arange(count) + 0.5) / count for count in _GRID]
    pixels = torch.cartesian_prod(*centres).double()
    others = torch.tensor(_thinned(train, _MOST))
    score = torch.zeros(len(cameras), dtype=torch.float64)
    for views in torch.split(torch.tensor(_thinned(range(len(cameras)), _MOST)), _CHUNK):
        view = views.repeat_interleave(len(pixels))
        origin, direction = rays_through(cameras, view, pixels.repeat(len(views), 1) * cameras.size[view])
        points = (origin[:, None] + direction[:, None] * distances[:, None]).reshape(-1, 3)
        other = others.repeat_interleave(len(points))
        pixel, _ = project(cameras, other, points.repeat(len(others), 1))
        seen = ((pixel >= 0) & (pixel <= cameras.size[other])).all(-1).view(len(others), len(points))
        way = torch.nn.functional.normalize(points - cameras.pose[others, None, :, 3], dim=-1)
        alike = (way * direction.repeat_interleave(len(distances), 0)).sum(-1) > _ANGLE
        count = (seen & alike).sum(0).double().view(len(views), -1)
        score[views] = (count / (count + _HALF)).mean(1)
    return score


def _thinned(views: Sequence[int], most: int) -> list[int]:
    """At most so many, at equal steps."""
    count = min(most, len(views))
    return [views[k * len(views) // count] for k in range(count)]
