"""The sun that a capture was taken in, found from its colours.

In the sun's light a surface is brighter by log(1 + s m / a) than in its shade, with the share m of the sun's light
that meets it, the share a of the sky's, and the sun's strength s over the sky's. So within groups of one hue the
logarithm of scene light (behind a camera's shoulder, as in `relight`) has to follow that of the right direction: the
share of its variance that this explains, at a slope of 1, tells directions apart. Under clouds and in the shade no
direction explains much.

N Gaussians that are looked at, D directions.
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from .relight import GROUND_ALBEDO, SHOULDER, Received, level_share, linear, sky_share
from .sky import LUMA

USUAL_STRENGTH = 2.0
"""s above while directions are tried: on towns 0.5 and 5 find fewer."""
_STRENGTHS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Of these the best for each channel, once the direction is found."""
_GROUPS = 4
"""Of hue: 6 and 10 find fewer suns on towns, as shade has another hue than sunlight."""
_ROUNDS = 15
"""Of finding groups."""
_DARKEST = 0.02
"""Added to light before logarithms are taken: below lies noise."""
_MAX_DEVIATION = 2.0
"""Deviations from the mean of a group that count, in standard ones."""
_MIN_SKY = 0.15
"""Least share of the sky's light, so that ratios are finite."""


class CapturedSun(NamedTuple):
    """A sun that a capture was taken in."""

    azimuth: float
    """Degrees clockwise from azimuth 0."""
    elevation: float
    """Degrees above the horizon."""
    explained: float
    """Share of the variance of log light within groups that it explains, at most 1."""
    strength: Annotated[Tensor, "3"]
    """s above of red, green and blue."""


def scene_light(colours: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    """Linear light before a camera's shoulder, from sRGB."""
    light = linear(colours.clamp(0, 1))
    return light / (1 - SHOULDER * light)


def sky_ratio(
    received: Received, meets: Annotated[Tensor, "N"], up: Annotated[Tensor, "3"]
) -> Annotated[Tensor, "N"]:
    """m / a above."""
    level = level_share(received, up)
    sky = sky_share(received) * (level + (1 - level) * GROUND_ALBEDO)
    return meets / sky.clamp_min(_MIN_SKY)


class LogLight:
    """Logarithms of scene light, less their means in groups of one hue."""

    def __init__(self, colours: Annotated[Tensor, "N 3"]) -> None:
        light = scene_light(colours)
        log = (light + _DARKEST).log()
        # Hues without the axis from red to blue would stay in the shade, but tell too little apart.
        hue = torch.stack([0.5 * (log[:, 0] - log[:, 2]), log[:, 1] - 0.5 * (log[:, 0] + log[:, 2])], 1)
        self._group = _groups(hue, _GROUPS)
        luma = (light @ torch.tensor(LUMA) + _DARKEST).log()
        self._luma = self._told(luma)
        self._channels = [self._told(part) for part in log.unbind(1)]

    def explained(self, ratio: Annotated[Tensor, "N"], strength: float) -> float:
        """Share of the variance of luma that a sun explains; negative where it disagrees."""
        return self._share(self._luma, ratio, strength)

    def strengths(self, ratio: Annotated[Tensor, "N"]) -> Annotated[Tensor, "3"]:
        """Strength of red, green and blue of a sun that explains most of them."""
        best = []
        for channel in self._channels:
            shares = [self._share(channel, ratio, strength) for strength in _STRENGTHS]
            best.append(_STRENGTHS[shares.index(max(shares))])
        return torch.tensor(best)

    def _share(self, told: Annotated[Tensor, "N"], ratio: Annotated[Tensor, "N"], strength: float) -> float:
        expected = self._within((1 + strength * ratio).log())
        return 1 - float((told - expected).square().sum() / told.square().sum().clamp_min(1e-12))

    def _told(self, values: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
        """Values less the means of their groups, without outliers."""
        apart = self._within(values)
        most = _MAX_DEVIATION * float(apart.square().mean().sqrt())
        return apart.clamp(-most, most)

    def _within(self, values: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
        sums = torch.zeros(_GROUPS).index_add_(0, self._group, values)
        counts = torch.zeros(_GROUPS).index_add_(0, self._group, torch.ones_like(values))
        return values - (sums / counts.clamp_min(1))[self._group]


def _groups(points: Annotated[Tensor, "N 2"], count: int) -> Annotated[Tensor, "N"]:
    """Index of the nearest of so many centres, which are the means of theirs (k-means), int64."""
    order = points[:, 0].argsort()
    centres = points[order[torch.linspace(0, len(points) - 1, count + 2)[1:-1].long()]].clone()
    for _ in range(_ROUNDS):
        nearest = torch.cdist(points, centres).argmin(1)
        for group in range(count):
            if bool((nearest == group).any()):
                centres[group] = points[nearest == group].mean(0)
    return torch.cdist(points, centres).argmin(1)
