"""Direction up in a capture whose file does not say it: found by the ground, a slab of level surfaces with
everything else on one side of it.

Only shapes decide, never colours: a restyled file is understood as the one that it was made of.
"""

from typing import Annotated, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..rendering.splines import rotations
from .gaussians import Gaussians, bulk_of

Direction: TypeAlias = tuple[float, float, float]

USUAL_UP: Direction = (0.0, -1.0, 0.0)
"""Direction that points up in captures of which nothing tells it: COLMAP's, in which y points down."""

_ASKED_GAUSSIANS = 20_000
"""Gaussians that are looked at: twice as many find the same slabs, to 0.01 of their share."""
_SLAB_THICKNESS = 0.03
"""Of the longest side of the bulk: the ground of a yard with grass and noise is thinner (by eye)."""
_MAX_DISTANCE = 1.0
"""Extents of the bulk from it, beyond which Gaussians are surroundings, where skies and hazes lie."""
_MAX_AREA_QUANTILE = 0.98
"""Larger Gaussians count as this one does: a few in the background are larger than all of a ground."""
_MIN_GROUND_SHARE = 0.3
"""Of the level surfaces that lie in the slab, at least. Eight captures of objects and seven trained scenes: 0.4
to 0.75 in the three that stand on a plane, at most 0.26 along y and 0.31 along z in the others, whose walls and
tables say nothing.
"""
_MAX_BELOW_SHARE = 0.07
"""Of all surfaces, below the ground: noise alone. The two captures on a ground have 0.01 and 0.07, those on
tables 0.28 and more.
"""
_MIN_ABOVE_SHARE = 0.1
"""Of all surfaces, above the ground, at least: a slab alone says no side (by eye)."""
_MAX_CEILING = 0.5
"""Of the share of the ground in a second slab above it, at most: else it may be a room's ceiling (by eye)."""
_MAX_RIVAL = 0.75
"""Of the share of the ground in a slab across another axis, at most: else it may be a wall. A box of cards
has 0.72.
"""
_MAX_RIVAL_OF_Z = 0.5
"""The same where the ground lies across z, along which captures that are not of z up have their walls."""
_MAX_HEIGHT_OF_Z = 0.75
"""Extent along z over those along x and y where the ground lies across z, at most: a statue before a wall has
0.78, a yard 0.43.
"""


class Ground(NamedTuple):
    """The ground of a capture."""

    up: Direction
    """The axis that points away from it, to where the other surfaces are."""
    share: float
    """Of the level surfaces, in it."""

    def __str__(self) -> str:
        down = axis_name((-self.up[0], -self.up[1], -self.up[2]))
        return f"{self.share:.0%} of its level surfaces lie in one plane at {down}, and all else on one side"


def axis_name(direction: Direction) -> str:
    """An axis with its sign, such as -y; of another direction its three numbers."""
    for letter, number in zip("xyz", direction, strict=True):
        others = sum(map(abs, direction)) - abs(number)
        if number and not others:
            sign = "+" if number > 0 else "-"
            return f"{sign}{letter}"
    return " ".join(f"{number:g}" for number in direction)


def find_ground(gaussians: Gaussians) -> Ground | None:
    """The ground of Gaussians that can be drawn, across y or z; None where there is none, or no plain one."""
    count = len(gaussians)
    asked = min(count, _ASKED_GAUSSIANS)
    some = gaussians.select(torch.arange(asked) * count // max(asked, 1))
    bulk = bulk_of(some.means.numpy())
    near = torch.from_numpy(bulk.apart <= _MAX_DISTANCE)
    some = some.select(near)
    if bulk.side == 0 or not len(some):
        return None
    means = some.means.double().numpy()
    areas, level = _areas(some)
    if not areas.sum() > 0:
        return None
    slabs = []
    for axis in range(3):
        slabs.append(_densest_slab(means[:, axis], areas, level[:, axis], _SLAB_THICKNESS * bulk.side))
    extents = np.subtract(*np.percentile(means, (95, 5), axis=0))
    # The axis whose slab holds most, if it holds much more than those across the other axes.
    axis = max((1, 2), key=lambda each: slabs[each].share)
    slab = slabs[axis]
    across = []
    for each in range(3):
        if each != axis:
            across.append(each)
    rival = max(slabs[each].share for each in across)
    flat = extents[axis] <= _MAX_HEIGHT_OF_Z * extents[across].min()
    if axis == 2 and not (flat and rival <= _MAX_RIVAL_OF_Z * slab.share):
        return None
    if slab.share < _MIN_GROUND_SHARE or rival > _MAX_RIVAL * slab.share:
        return None
    below = min(slab.before, slab.after)
    above = max(slab.before, slab.after)
    if below > _MAX_BELOW_SHARE or above < _MIN_ABOVE_SHARE or slab.second > _MAX_CEILING * slab.share:
        return None
    sign = 1.0 if slab.after > slab.before else -1.0
    up = [0.0, 0.0, 0.0]
    up[axis] = sign
    return Ground((up[0], up[1], up[2]), slab.share)


class _Slab(NamedTuple):
    """The densest slab across an axis."""

    share: float
    """Of level surfaces, in it."""
    second: float
    """Of level surfaces, in the densest slab that does not touch it."""
    before: float
    after: float
    """Of all surfaces, at lower and at higher coordinates."""


def _areas(gaussians: Gaussians) -> tuple[Annotated[NDArray[np.float64], "N"], NDArray[np.float64]]:
    """Visible part of each Gaussian: its largest section times its opacity, and the part [N 3] of that which
    lies across each axis.
    """
    sizes = gaussians.log_scales.double().exp()
    turns = rotations(torch.nn.functional.normalize(gaussians.quaternions.double(), dim=1))
    products = sizes[:, [1, 0, 0]] * sizes[:, [2, 2, 1]]
    # The section across the world's axis a is that of an ellipsoid's shadow: the root of the sum, over its own
    # axes, of (cosine to a, times the product of the two other sizes) squared.
    shadows = ((turns * products[:, None]) ** 2).sum(2).sqrt()
    largest = products.amax(1)
    seen = largest.clamp_max(float(largest.quantile(_MAX_AREA_QUANTILE))) * gaussians.opacities.double()
    share: Tensor = shadows / largest.clamp_min(torch.finfo(torch.float64).tiny)[:, None]
    return seen.numpy(), (seen[:, None] * share.clamp_max(1.0)).numpy()


def _densest_slab(
    places: NDArray[np.float64], areas: NDArray[np.float64], level: NDArray[np.float64], thickness: float
) -> _Slab:
    """The slab of a thickness that holds most of the level surfaces, of places [N] along an axis."""
    order = np.argsort(places)
    ordered = places[order]
    sums = np.concatenate([[0.0], np.cumsum(level[order])])
    all_sums = np.concatenate([[0.0], np.cumsum(areas[order])])
    ends = np.searchsorted(ordered, ordered + thickness, side="right")
    shares = (sums[ends] - sums[:-1]) / max(sums[-1], np.finfo(np.float64).tiny)
    first = int(shares.argmax())
    last = int(ends[first])
    apart = (ordered + 2 * thickness < ordered[first]) | (ordered > ordered[last - 1] + thickness)
    second = float(shares[apart].max(initial=0.0))
    before = float(all_sums[first] / all_sums[-1])
    after = float(1 - all_sums[last] / all_sums[-1])
    return _Slab(float(shares[first]), second, before, after)
