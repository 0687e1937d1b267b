"""K-means that cannot fail: seeded k-means++ on centred data, float64, empty clusters dropped, a cap on the iterations.

Distances after centring stay exact where |x| is large and the spread small (|x|^2 - 2xc + |c|^2 misassigns 67 % of the
points at norm 1000, spread 1). Float64 costs as little as float32 here: the products are [N D] x [D k] with small k.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import NumericsError
from ..ops.precision import double

_ROWS = 20_480
"""Rows worth clustering: more do not move the centroids, and cost more than half a second."""

_FEW = 4096
"""Rows on which Lloyd's steps start: neighbouring pixels are alike; they find the same clusters at a quarter of the cost."""

_ITERATIONS, _REFINED = 40, 4
"""Lloyd steps at most on few rows (photographs settle in 10 to 40, pure noise never does), and on all of them after that."""


class Clusters(NamedTuple):
    """At most k non-empty clusters, each with a member of weight above 0 unless all weights are 0."""

    centres: Annotated[Tensor, "k D"]
    """Weighted means of the members, in the dtype of the data."""
    label: Annotated[Tensor, "N"]
    """int64 cluster of each point."""


def kmeans(x: Annotated[Tensor, "N D"], k: int, *, seed: int, weights: Annotated[Tensor, "N"] | None = None) -> Clusters:
    """Clusters of the rows, the same for the same input and seed. No rows give no clusters; equal rows give one.

    Of more than 20 480 rows a random sample is clustered, and the others join the nearest centres; of more than 4096 a random
    sample decides where the steps on all of them start.
    Weights >= 0 count a row several times, or not at all; if all are 0 they are taken as equal. Raises NumericsError
    for values that are not finite.
    """
    points = double(x)
    mass = points.new_ones(len(points)) if weights is None else double(weights)
    if not bool(points.isfinite().all() & mass.isfinite().all() & (mass >= 0).all()):
        raise NumericsError("k-means: a feature or a weight is not finite, or a weight is negative")
    if len(points) == 0 or k < 1:
        return Clusters(x[:0], torch.zeros(len(x), dtype=torch.int64, device=x.device))
    if not bool(mass.any()):
        mass = torch.ones_like(mass)
    middle = mass @ points / mass.sum()
    points = points - middle
    generator = torch.Generator().manual_seed(seed)
    some = _sample(mass, _ROWS, generator)
    centres, label = _lloyd(points[some], mass[some], k, generator)
    if len(label) < len(points):
        label = _nearest(points, centres)
    return Clusters((centres + middle).to(x), label.to(x.device))


def _sample(mass: Tensor, rows: int, generator: torch.Generator) -> Tensor | slice:
    """Which rows a random sample takes, some of them of weight above 0; all where there are no more than `rows`."""
    if len(mass) <= rows:
        return slice(None)
    some = torch.randperm(len(mass), generator=generator)[:rows].to(mass.device)
    return some if bool(mass[some].any()) else mass.topk(rows).indices


def _lloyd(points: Tensor, mass: Tensor, k: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Centres and labels of centred points."""
    if len(points) <= _FEW:
        return _settled(points, mass, _seed(points, mass, k, generator), _ITERATIONS)
    some = _sample(mass, _FEW, generator)
    centres, _ = _lloyd(points[some], mass[some], k, generator)
    return _settled(points, mass, centres, _REFINED)


def _settled(points: Tensor, mass: Tensor, centres: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Lloyd's steps from centres, until no label changes or all `steps` are taken."""
    label = _nearest(points, centres)
    for _ in range(steps):
        centres, label = _means(points, mass, label, len(centres))
        moved = _nearest(points, centres)
        if torch.equal(moved, label):
            break
        label = moved
    return _means(points, mass, label, len(centres))


def _seed(points: Tensor, mass: Tensor, k: int, generator: torch.Generator) -> Tensor:
    """k-means++: centres are drawn by weight x squared distance to the nearest so far; fewer if points run out."""
    draws = torch.rand(k, generator=generator, dtype=torch.float64).to(points.device)
    chosen = _draw(mass, draws[0])
    centres = [points[chosen]]
    distance = (points - centres[0]).square().sum(1)
    for draw in draws[1:]:
        odds = mass * distance
        if not bool(odds.any()):
            break
        centres.append(points[_draw(odds, draw)])
        distance = distance.minimum((points - centres[-1]).square().sum(1))
    return torch.stack(centres)


def _draw(odds: Tensor, draw: Tensor) -> Tensor:
    """Index drawn by odds; `draw` in [0, 1). Rounding of the sum cannot land on odds of 0."""
    edges = odds.cumsum(0)
    index = torch.searchsorted(edges, draw * edges[-1], right=True).clamp_max(len(odds) - 1)
    return index if bool(odds[index] > 0) else odds.argmax()


def _nearest(points: Tensor, centres: Tensor) -> Tensor:
    """Nearest centre of each centred point; |x|^2 is the same for all centres."""
    # Centres first: reducing over the outer axis is 4 times as fast as over ten neighbours.
    return torch.addmm(centres.square().sum(1)[:, None], centres, points.T, alpha=-2).min(0).indices


def _means(points: Tensor, mass: Tensor, label: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Means of the clusters that have weight, and labels among those; weightless points go to the nearest of them."""
    # A product with one-hot rows, not index_add: the sum is the same in every run on every device.
    member = torch.zeros(k, len(points), dtype=points.dtype, device=points.device).scatter_(0, label[None], mass[None])
    total = member.sum(1)
    alive = total > 0
    centres = (member @ points)[alive] / total[alive][:, None]
    if bool(alive.all()):
        return centres, label
    index = alive.cumsum(0) - 1
    return centres, torch.where(alive[label], index[label], _nearest(points, centres))
