"""Statistics of features: weighted moments, k-means, and optimal transport between Gaussians.

Letters: N rows, C channels, K groups, T codes, k clusters. Sums run in float64 on centred data.

Moments merge exactly (Chan): any order and partition gives the same within 1e-12. Scatter is the weighted sum
of outer products about the mean; covariance = scatter / weight (not Bessel-corrected: weights are rendering
weights, not counts).

Optimal transport (Monge), c content, s style: T = Cs^1/2 (Cs^1/2 Cc Cs^1/2)^-1/2 Cs^1/2 is the one symmetric
positive map with T Cc T = Cs: of all linear maps that give the style's covariance it moves the features
least. Computed by one singular value decomposition, Cs^1/2 Cc^1/2 = U S V^T, so that T = Cs^1/2 U S^-1 U^T
Cs^1/2: S has the square root of the condition of the product under the inverse root above, which would lose
half of the digits.

K-means cannot fail: seeded k-means++, empty clusters dropped, a cap on the steps. Distances after centring
stay exact where
|x| is large and the spread small (|x|^2 - 2xc + |c|^2 misassigns 67 % of the points at norm 1000, spread 1). Float64 costs as
little as float32 here: the products are [N D] x [D k] with small k.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import NumericsError
from ..ops.backend import double, float64_device

_CENTRED_ROWS = 16384
"""Rows centred at a time: bounds the float64 copies of large inputs."""

_MIN_DEVIATION_SHARE = 0.01
"""A channel deviates by at least this share of the median channel: noise of dead channels must not become
style.
"""

_MEAN_ROUNDING_SHARE = 1e-6
"""A deviation below this share of the mean is float32 rounding."""


class Moments(NamedTuple):
    """Weight, mean and scatter of weighted rows, all float64."""

    weight: Annotated[Tensor, ""]
    mean: Annotated[Tensor, "C"]
    scatter: Annotated[Tensor, "C C"]


def empty(channels: int, *, device: torch.device | None = None) -> Moments:
    """The moments of nothing: the neutral element of `merge`."""
    zero = torch.zeros(channels, dtype=torch.float64, device=device)
    return Moments(zero.new_zeros(()), zero, zero.new_zeros(channels, channels))


def moments(features: Annotated[Tensor, "N C"], weights: Annotated[Tensor, "N"]) -> Moments:
    """Moments of rows with weights >= 0; rows of weight 0 count for nothing, whatever they hold.

    Raises NumericsError where a row that counts, or a weight, is not finite.
    """
    total = empty(features.shape[1], device=float64_device(features.device))
    for start in range(0, len(features), _CENTRED_ROWS):
        rows = features[start : start + _CENTRED_ROWS]
        mass = double(weights[start : start + _CENTRED_ROWS])
        if not bool((mass >= 0).all() & mass.isfinite().all()):
            raise NumericsError(
                "statistics: a weight is negative or not finite; weights must be finite and at least 0"
            )
        # Rows of weight 0 leave before they are looked at: they may hold anything.
        counted = mass > 0
        if not bool(counted.any()):
            continue
        if not bool(counted.all()):
            rows = rows[counted.to(rows.device)]
            mass = mass[counted]
        rows = double(rows)
        if not bool(rows.isfinite().all()):
            raise NumericsError(
                "statistics: a content feature is not finite; check the field or encoder that made it"
            )
        # Mean and scatter of this chunk.
        weight = mass.sum()
        mean = mass @ rows / weight
        rows = rows - mean
        # The mean's own rounding error is carried to second order only: the centred rows are corrected once.
        correction = mass @ rows / weight
        rows = (rows - correction) * mass.sqrt()[:, None]
        total = merge(total, Moments(weight, mean + correction, rows.T @ rows))
    return total


def merge(a: Moments, b: Moments) -> Moments:
    """Moments of both inputs together (Chan, Golub, LeVeque 1979). Commutative and associative within
    1e-12.
    """
    # The mean moves by b's share of the way; the scatter gains what the means lie apart.
    weight = a.weight + b.weight
    share = b.weight / torch.where(weight > 0, weight, 1.0)
    shift = b.mean - a.mean
    scatter = a.scatter + b.scatter + torch.outer(shift, shift) * (a.weight * share)
    mean = torch.where(weight > 0, (1 - share) * a.mean + share * b.mean, a.mean)
    return Moments(weight, mean, scatter)


def covariance(m: Moments) -> Annotated[Tensor, "C C"]:
    """Covariance, symmetric bit for bit; zero where there is no weight."""
    c = m.scatter / torch.where(m.weight > 0, m.weight, 1.0)
    return (c + c.T) / 2


def group_moments(
    features: Annotated[Tensor, "N C"], membership: Annotated[Tensor, "N K"]
) -> tuple[Annotated[Tensor, "K C"], Annotated[Tensor, "K C C"], Annotated[Tensor, "K"]]:
    """Mean, covariance and share of the weight of each (soft) group, float64.

    Membership is the weight >= 0 of each row in each group; only rows that belong to a group are visited for
    it, so sharp memberships cost one group. An empty group has the mean and covariance of nothing: zero.
    """
    groups = []
    for k, inside in enumerate((column > 0).nonzero().squeeze(1) for column in membership.T):
        groups.append(moments(features[inside.to(features.device)], membership[inside, k]))
    # Shares of all weight; where there is none at all they are 0, not NaN.
    parts = []
    for g in groups:
        parts.append(g.weight)
    weight = torch.stack(parts)
    parts = []
    for g in groups:
        parts.append(g.mean)
    mean = torch.stack(parts)
    parts = []
    for g in groups:
        parts.append(covariance(g))
    return (
        mean,
        torch.stack(parts),
        weight / weight.sum().clamp_min(torch.finfo().tiny),
    )


def mix(
    mean: Annotated[Tensor, "T C"], covariances: Annotated[Tensor, "T C C"], share: Annotated[Tensor, "T"]
) -> tuple[Annotated[Tensor, "C"], Annotated[Tensor, "C C"]]:
    """Mean and covariance of groups taken together, by the law of total covariance. Shares need not sum to
    1.
    """
    mean = double(mean)
    covariances = double(covariances)
    share = double(share)
    # The scatter within groups, and that of their means about the mean of all.
    share = share / share.sum()
    whole = share @ mean
    apart = (mean - whole) * share.sqrt()[:, None]
    return whole, torch.einsum("t,tij->ij", share, covariances) + apart.T @ apart


def deviation(
    mean: Annotated[Tensor, "... C"], variance: Annotated[Tensor, "... C"]
) -> Annotated[Tensor, "... C"]:
    """Standard deviation per channel, never below 1 % of the median channel's nor below float32 rounding of
    the means.

    The floor is relative, so it biases no live channel, whatever the encoder's scale; always above 0.
    """
    sigma = variance.clamp_min(0.0).sqrt()
    floor = _MIN_DEVIATION_SHARE * sigma.median(dim=-1, keepdim=True).values
    rounding = _MEAN_ROUNDING_SHARE * mean.abs().amax(dim=-1, keepdim=True)
    return sigma.maximum(floor.maximum(rounding).clamp_min(1e-12))


_MONGE_RIDGE_SHARE = 1e-4
"""Variance added in every direction, as a share of the mean variance: 1 % of the deviation, as AdaIN's
floor.
"""


def symmetric_root(c: Annotated[Tensor, "... C C"]) -> Annotated[Tensor, "... C C"]:
    """The symmetric positive root of symmetric matrices; negative eigenvalues (rounding) count as 0."""
    value, vector = torch.linalg.eigh(c)
    root: Tensor = (vector * value.clamp_min(0.0).sqrt()[..., None, :]) @ vector.mT
    return root


def monge(
    content: Annotated[Tensor, "... C C"], style: Annotated[Tensor, "... C C"], *, gain: float
) -> Annotated[Tensor, "... C C"]:
    """Symmetric T [C C], float64, with T content T = style, for covariances of any rank, 0 among them.

    Both sides get the same relative ridge, so equal covariances give the identity; eigenvalues of T above
    `gain` (>= 1) are capped, which is where it stops matching the style exactly.
    """
    # T by one singular value decomposition (see the top of the file), as a product that is symmetric up to
    # rounding.
    style_root = symmetric_root(_with_ridge(double(style)))
    left, value, _ = torch.linalg.svd(style_root @ symmetric_root(_with_ridge(double(content))))
    half = style_root @ (left / value.clamp_min(torch.finfo(value.dtype).tiny).sqrt()[..., None, :])
    product = half @ half.mT
    t = (product + product.mT) / 2
    # Cap the eigenvalues; where none is too large the map stays untouched, bit for bit.
    value, vector = torch.linalg.eigh(t)
    capped = (vector * value.clamp(0.0, gain)[..., None, :]) @ vector.mT
    return torch.where((value[..., -1] > gain)[..., None, None], (capped + capped.mT) / 2, t)


def _with_ridge(c: Tensor) -> Tensor:
    c = (c + c.mT) / 2
    variance = c.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(torch.finfo(c.dtype).tiny ** 0.5)
    return c + _MONGE_RIDGE_SHARE * variance[..., None, None] * torch.eye(
        c.shape[-1], dtype=c.dtype, device=c.device
    )


_MAX_CLUSTERED_ROWS = 20_480
"""Rows worth clustering: more do not move the centroids, and cost more than half a second."""

_SEEDING_ROWS = 4096
"""Rows on which Lloyd's steps start: neighbouring pixels are alike; they find the same clusters at a quarter
of the cost.
"""

_MAX_SEEDING_STEPS = 40
"""Lloyd steps on few rows: photographs settle in 10 to 40, pure noise never does."""
_MAX_REFINING_STEPS = 4
"""Lloyd steps on all rows after that: the same inertia as 40, 2.5 times as fast (commit 4e44a8dd)."""


class Clusters(NamedTuple):
    """At most k non-empty clusters, each with a member of weight above 0 unless all weights are 0."""

    centres: Annotated[Tensor, "k D"]
    """Weighted means of the members, in the dtype of the data."""
    label: Annotated[Tensor, "N"]
    """int64 cluster of each point."""


def kmeans(
    x: Annotated[Tensor, "N D"], k: int, *, seed: int, weights: Annotated[Tensor, "N"] | None = None
) -> Clusters:
    """Cluster rows, the same for the same input and seed. No rows give no clusters; equal rows give one.

    Of more than 20 480 rows a random sample is clustered, and the others join the nearest centres; of more
    than 4096 a random sample decides where the steps on all of them start. Weights >= 0 count a row several
    times, or not at all; if all are 0 they are taken as equal. Raises NumericsError for values that are not
    finite.
    """
    points = double(x)
    if weights is None:
        mass = points.new_ones(len(points))
    else:
        mass = double(weights)
    if not bool(points.isfinite().all() & mass.isfinite().all() & (mass >= 0).all()):
        raise NumericsError("k-means: a feature or a weight is not finite, or a weight is negative")
    if len(points) == 0 or k < 1:
        return Clusters(x[:0], torch.zeros(len(x), dtype=torch.int64, device=x.device))
    if not bool(mass.any()):
        mass = torch.ones_like(mass)
    # Centred first: what follows compares squared lengths.
    middle = mass @ points / mass.sum()
    points = points - middle
    generator = torch.Generator().manual_seed(seed)
    # Sample, and begin on a sample of the sample: seeding and most of the steps see few rows.
    some = _sample(mass, _MAX_CLUSTERED_ROWS, generator)
    rows = points[some]
    row_mass = mass[some]
    few = _sample(row_mass, _SEEDING_ROWS, generator)
    centres = _seed(rows[few], row_mass[few], k, generator)
    centres, label = _lloyd(rows[few], row_mass[few], centres, _MAX_SEEDING_STEPS)
    if len(rows) > _SEEDING_ROWS:
        centres, label = _lloyd(rows, row_mass, centres, _MAX_REFINING_STEPS)
    # Rows outside of the samples get labels, but do not move the centres.
    if len(label) < len(points):
        label = _nearest(points, centres)
    return Clusters((centres + middle).to(x), label.to(x.device))


def _sample(mass: Tensor, rows: int, generator: torch.Generator) -> Tensor | slice:
    """Draw `rows` random rows, some of them of weight above 0; take all where there are no more."""
    if len(mass) <= rows:
        return slice(None)
    some = torch.randperm(len(mass), generator=generator)[:rows].to(mass.device)
    if bool(mass[some].any()):
        return some
    return mass.topk(rows).indices


def _lloyd(points: Tensor, mass: Tensor, centres: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Take Lloyd's steps until no label changes, `steps` at most; return centres and labels of centred
    points.
    """
    label = _nearest(points, centres)
    for _ in range(steps):
        centres, label = _means(points, mass, label, len(centres))
        moved = _nearest(points, centres)
        if torch.equal(moved, label):
            break
        label = moved
    return _means(points, mass, label, len(centres))


def _seed(points: Tensor, mass: Tensor, k: int, generator: torch.Generator) -> Tensor:
    """Draw centres by weight x squared distance to the nearest so far (k-means++); fewer if points run
    out.
    """
    centres: list[Tensor] = []
    odds = mass
    distance = torch.full_like(mass, torch.inf)
    # One number a centre, drawn on the CPU: the same on every device.
    for draw in torch.rand(k, generator=generator, dtype=torch.float64).to(points.device):
        # Rounding of the sum cannot land on odds of 0.
        edges = odds.cumsum(0)
        index = torch.searchsorted(edges, draw * edges[-1], right=True).clamp_max(len(odds) - 1)
        if not bool(odds[index] > 0):
            index = odds.argmax()
        centres.append(points[index])
        distance = distance.minimum((points - centres[-1]).square().sum(1))
        odds = mass * distance
        if not bool(odds.any()):
            break  # no row is left that is not a centre already: fewer clusters than asked for
    return torch.stack(centres)


def _nearest(points: Tensor, centres: Tensor) -> Tensor:
    """Find the nearest centre of each centred point; |x|^2 is the same for all centres and left out."""
    # Centres first: reducing over the outer axis is 4 times as fast as over ten neighbours.
    return torch.addmm(centres.square().sum(1)[:, None], centres, points.T, alpha=-2).min(0).indices


def _means(points: Tensor, mass: Tensor, label: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return means of the clusters that have weight, and labels among those; weightless points go to the
    nearest of them.
    """
    # A product with one-hot rows, not index_add: the sum is the same in every run on every device.
    member = torch.zeros(k, len(points), dtype=points.dtype, device=points.device).scatter_(
        0, label[None], mass[None]
    )
    total = member.sum(1)
    alive = total > 0
    centres = (member @ points)[alive] / total[alive][:, None]
    if bool(alive.all()):
        return centres, label
    index = alive.cumsum(0) - 1
    return centres, torch.where(alive[label], index[label], _nearest(points, centres))
