"""How brightly each view was taken, measured where several views see the same point of the reconstruction.

A sighting's brightness is b = g(view) + a(point) in the logarithm of sRGB; least squares gives both, twice: the second time
without outliers (highlights, points that something hides). Training views alone are looked at.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from .scene import Scene
from .sightings import Sightings, find_sightings

__all__ = ["DIFFERENT", "GAMMA", "differ", "with_exposure"]

GAMMA = 1 / 2.2
"""Light is in proportion to exposure, sRGB to about this power of light."""
DIFFERENT = 0.08
"""Standard deviation of the views' brightness, in the logarithm of sRGB, above which exposures differ."""
LEAST = 16
"""Sightings of a view that its exposure is measured from, at least."""
MOST = 1 << 19
"""Pairs of a view and a point that are looked at, about."""
DARK, BRIGHT = 0.03, 0.97
"""sRGB outside of which a pixel says nothing: noise, or clipped."""


def differ(exposure: Annotated[Tensor, "V"] | None) -> bool:
    """Whether views were taken so differently that each needs a factor of its own; not where nothing is known."""
    return exposure is not None and len(exposure) > 1 and GAMMA * float(exposure.log().std()) > DIFFERENT


def with_exposure(scene: Scene, image: Callable[[int], Annotated[Tensor, "H W 3"]]) -> Scene:
    """The scene with the exposure of its views, measured where the capture does not say it; unchanged without points.

    `image(view)` is a training view, in [0, 1]. Held-out views take the mean of their neighbours in the order of names, as far
    as training views resemble theirs: pictures taken one after the other do, those of a collection do not.
    """
    if scene.exposure is not None or len(scene.train) < 2:
        return scene
    sightings = find_sightings(_sparser(scene))
    gain = None if sightings is None else _gains(sightings, scene, image)
    if gain is None:
        return scene
    train = scene.train.sort().values
    gain[train] -= gain[train].mean()
    # Correlation of neighbours, from the squares of their differences: 0 where the order says nothing.
    alike = (1 - gain[train].diff().square().mean() / (2 * gain[train].var()).clamp_min(1e-12)).clamp(0, 1)
    after = torch.searchsorted(train, scene.test)
    before, after = train[(after - 1).clamp_min(0)], train[after.clamp_max(len(train) - 1)]
    gain[scene.test] = alike * (gain[before] + gain[after]) / 2
    return replace(scene, exposure=(gain / GAMMA).exp())


def _sparser(scene: Scene) -> Scene:
    """The scene with every n-th point, so that about MOST pairs are left."""
    if scene.points is None:
        return scene
    step = -(-(len(scene.points) * len(scene.train) if scene.seen is None else len(scene.seen)) // MOST) or 1
    seen = scene.seen
    if seen is not None:
        seen = seen[seen[:, 1] % step == 0] // torch.tensor([1, step])
    return replace(scene, points=scene.points[::step], seen=seen)


def _gains(
    sightings: Sightings, scene: Scene, image: Callable[[int], Annotated[Tensor, "H W 3"]]
) -> Annotated[Tensor, "V"] | None:
    """g of the training views, 0 of those that too few sightings tell of; None where none is left. float64."""
    rgb = torch.full((len(sightings.view), 3), torch.nan, dtype=torch.float64)
    for view in scene.train.tolist():
        at = (sightings.view == view).nonzero()[:, 0]
        x, y = sightings.pixel[at].long().unbind(1)
        rgb[at] = image(view)[y, x].double()
    kept = ((rgb >= DARK) & (rgb <= BRIGHT)).all(1)
    view, bright = sightings.view[kept], rgb[kept].log().mean(1)
    point = torch.unique(sightings.point[kept], dim=0, return_inverse=True)[1]
    gain = None
    for _ in range(2):
        known = torch.bincount(view, minlength=len(scene.paths))[view] >= LEAST
        shared = torch.bincount(point)[point] >= 2
        view, point, bright = (x[known & shared] for x in (view, point, bright))
        if not len(view):
            break
        gain, error = _solve(view, point, bright, len(scene.paths))
        inlier = error.abs() <= 3 * error.abs().median() / 0.6745  # of a normal error three standard deviations
        view, point, bright = view[inlier], point[inlier], bright[inlier]
    return gain


def _solve(
    view: Annotated[Tensor, "O"], point: Annotated[Tensor, "O"], bright: Annotated[Tensor, "O"], views: int
) -> tuple[Annotated[Tensor, "V"], Annotated[Tensor, "O"]]:
    """g of the views and what it leaves of each sighting, by conjugate gradients on the equations without the points."""
    seen = torch.bincount(point).clamp_min(1).double()

    def centred(values: Tensor) -> Tensor:
        """Less their mean at each point."""
        return values - (values.new_zeros(len(seen)).index_add(0, point, values) / seen)[point]

    def gathered(values: Tensor) -> Tensor:
        return values.new_zeros(views).index_add(0, view, values)

    gain = bright.new_zeros(views)
    residual = gathered(centred(bright))
    direction, power = residual, float(residual @ residual)
    limit = 1e-12 * power
    for _ in range(min(views, 200)):
        if power <= limit or not math.isfinite(power):
            break
        moved = gathered(centred(direction[view]))
        length = power / float(direction @ moved)
        gain, residual = gain + length * direction, residual - length * moved
        last, power = power, float(residual @ residual)
        direction = residual + power / last * direction
    return gain, centred(bright - gain[view])
