"""The sun that a capture was taken in, found from its colours.

In the sun's light a surface is brighter by log(1 + s m / a) than in its shade, with the share m of the sun's light
that meets it, the share a of the sky's, and the sun's strength s over the sky's. So within groups of one hue the
logarithm of scene light (behind a camera's shoulder, as in `relight`) has to follow that of the right direction. It
follows log a, too, under clouds above all: of both what log a explains is taken away first, by least squares. The
share of the variance of the rest that log(1 + s m / a) explains tells directions apart, together with the same in
groups of neighbours that face one way, where shadows alone differ. Under clouds and in the shade no direction explains
much.

N Gaussians that are looked at, D directions.
"""

import math
from collections.abc import Callable
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..io.images import srgb_to_linear
from .relight import GROUND_ALBEDO, SHOULDER, Received, level_share, sky_share
from .sky import LUMA

_SOUGHT_STRENGTH = 10.0
"""s above while directions are tried. On 36 towns (seeds 41 to 52, 61 to 84) 3 finds two suns
fewer; on the first twelve 6, 10 and 20 find as many.
"""
_STRENGTHS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Of these the best for each channel, once the direction is found."""
_KINDS = 2
"""Groups of one hue: on the same towns 1 and 4 find two and three suns fewer, as shade has another hue."""
_PLACES = 30
"""Groups of neighbours of one hue that face one way: with 20 to 60 by other distances the count changes by
one or two suns; without these groups it is two less.
"""
_PLACES_SHARE = 0.5
"""Part of these groups in the evidence: 1 finds one sun fewer."""
_PLACE_SHARE = 2.0
"""Distance in a group of the median distance from the middle (by eye)."""
_NORMAL_SHARE = 2.0
"""Distance of normals at right angles, over the root of two: 1 and 4 do alike."""
_HUE_SHARE = 5.0
"""Distance of a hue of one more in its logarithm: 1.5 finds two suns fewer, none one."""
_MIN_SURE = 0.02
"""Weight of what has no sure normal."""
_ROUNDS = 15
"""Of finding groups."""
_DARKEST = 0.02
"""Added to light before logarithms are taken: below lies noise."""
_MAX_DEVIATION = 2.0
"""Deviations from the mean of a group that count, in standard ones."""
_MIN_SKY = 0.15
"""Least share of the sky's light, so that ratios are finite."""


_SOUGHT_AZIMUTHS = 16
"""Places around that are tried for the captured sun, at each elevation."""
_SOUGHT_ELEVATIONS = (30.0, 45.0, 60.0)
"""Degrees above the horizon. Lower ones explain much of towns under clouds, too: what faces them is brighter."""
_MIN_SOUGHT_ELEVATION = 25.0
"""Degrees above the horizon down to which it is sought."""
_SOUGHT_STEPS = (7.5, 7.5, 3.75)
"""Degrees about the best of these that are tried then."""
_FOLLOWED = 3
"""Places that are followed by these steps: the best of them is not always the nearest."""
_MIN_EVIDENCE = 0.06
"""Evidence of a captured sun (`LogLight.evidence`), at least: cloudy towns stay below (`captured_sun.json`)."""


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


def sought(evidence: Callable[[float, float], float]) -> tuple[float, float] | None:
    """Azimuth and elevation, in degrees, of the sun that there is most evidence of; None where there is too little."""
    tried = []
    for elevation in _SOUGHT_ELEVATIONS:
        for azimuth in [k * 360.0 / _SOUGHT_AZIMUTHS for k in range(_SOUGHT_AZIMUTHS)]:
            tried.append((evidence(azimuth, elevation), azimuth, elevation))
    starts = sorted(tried, reverse=True)[:_FOLLOWED]
    most, azimuth, elevation = max(_followed(start, evidence) for start in starts)
    if most < _MIN_EVIDENCE:
        return None
    return azimuth, elevation


def _followed(
    start: tuple[float, float, float], evidence: Callable[[float, float], float]
) -> tuple[float, float, float]:
    """Evidence, azimuth and elevation of the best sun that smaller and smaller steps reach from a start."""
    best = start
    for step in _SOUGHT_STEPS:
        around = [best]
        for eighth in range(8):
            turn = math.radians(45.0 * eighth)
            across = step * math.cos(turn) / max(math.cos(math.radians(best[2])), 0.2)
            azimuth = best[1] + across
            elevation = min(max(best[2] + step * math.sin(turn), _MIN_SOUGHT_ELEVATION), 89.0)
            around.append((evidence(azimuth, elevation), azimuth, elevation))
        best = max(around)
    return best


def scene_light(colours: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    """Linear light before a camera's shoulder, from sRGB."""
    light = srgb_to_linear(colours.clamp(0, 1))
    return light / (1 - SHOULDER * light)


def sky_part(received: Received, up: Annotated[Tensor, "3"]) -> Annotated[Tensor, "N"]:
    """a above, in [0.15, 1]."""
    level = level_share(received, up)
    sky = sky_share(received) * (level + (1 - level) * GROUND_ALBEDO)
    return sky.clamp_min(_MIN_SKY)


class LogLight:
    """Logarithms of scene light, less their means in groups and what the sky explains of them."""

    def __init__(
        self,
        colours: Annotated[Tensor, "N 3"],
        received: Received,
        points: Annotated[Tensor, "N 3"],
        up: Annotated[Tensor, "3"],
    ) -> None:
        light = scene_light(colours)
        log = (light + _DARKEST).log()
        luma = (light @ torch.tensor(LUMA) + _DARKEST).log()
        # Hues without the axis from red to blue would stay in the shade, but tell too little apart.
        hue = torch.stack([0.5 * (log[:, 0] - log[:, 2]), log[:, 1] - 0.5 * (log[:, 0] + log[:, 2])], 1)
        away = points - points.median(0).values
        place = _PLACE_SHARE * away / away.norm(dim=1).median().clamp_min(1e-12)
        near = torch.cat([place, _NORMAL_SHARE * received.normals, _HUE_SHARE * hue], 1)
        weight = received.sure.square().clamp_min(_MIN_SURE)
        sky = sky_part(received, up).log()
        self._kinds = _Within(_groups(hue, _KINDS), weight, sky)
        self._places = _Within(_groups(near, _PLACES), weight, sky)
        self._kinds_luma = self._kinds.told(luma)
        self._places_luma = self._places.told(luma)
        self._channels = [self._kinds.told(part) for part in log.unbind(1)]

    def explained(self, ratio: Annotated[Tensor, "N"]) -> float:
        """Share of the variance of luma in groups of one hue that a sun explains, from its m / a; 0 where it disagrees."""
        return _squared_likeness(self._kinds_luma, self._kinds(_brighter(ratio, _SOUGHT_STRENGTH)))

    def evidence(self, ratio: Annotated[Tensor, "N"]) -> float:
        """That share, and half of the same in groups of neighbours that face one way."""
        expected = self._places(_brighter(ratio, _SOUGHT_STRENGTH))
        return self.explained(ratio) + _PLACES_SHARE * _squared_likeness(self._places_luma, expected)

    def strengths(self, ratio: Annotated[Tensor, "N"]) -> Annotated[Tensor, "3"]:
        """Strength of red, green and blue of a sun that explains most of them, at a slope of 1."""
        best = []
        for channel in self._channels:
            rests = []
            for strength in _STRENGTHS:
                rest = channel - self._kinds(_brighter(ratio, strength))
                rests.append(float(rest.square().sum()))
            best.append(_STRENGTHS[rests.index(min(rests))])
        return torch.tensor(best)


class _Within:
    """Values less their weighted means in groups, and less what the logarithm of the sky's light explains of them by
    least squares; times the root of the weight.
    """

    def __init__(
        self,
        group: Annotated[Tensor, "N"],
        weight: Annotated[Tensor, "N"],
        sky: Annotated[Tensor, "N"],
    ) -> None:
        self._group = group
        self._weight = weight
        self._total = torch.zeros(int(group.max()) + 1).index_add_(0, group, weight)
        self._sky = torch.nn.functional.normalize(self._apart(sky) * weight.sqrt(), dim=0)

    def __call__(self, values: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
        return self._less_sky(self._apart(values))

    def told(self, values: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
        """The same without outliers."""
        apart = self._apart(values)
        most = _MAX_DEVIATION * float(apart.square().mean().sqrt())
        return self._less_sky(apart.clamp(-most, most))

    def _apart(self, values: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
        sums = torch.zeros_like(self._total).index_add_(0, self._group, values * self._weight)
        return values - (sums / self._total.clamp_min(1e-9))[self._group]

    def _less_sky(self, values: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
        values = values * self._weight.sqrt()
        return values - (values @ self._sky) * self._sky


def _brighter(ratio: Annotated[Tensor, "N"], strength: float) -> Annotated[Tensor, "N"]:
    """log(1 + s m / a) above."""
    return (1 + strength * ratio).log()


def _squared_likeness(told: Annotated[Tensor, "N"], expected: Annotated[Tensor, "N"]) -> float:
    """Share of the squares of `told` that a positive multiple of `expected` explains."""
    product = max(float(told @ expected), 0.0)
    return product * product / max(float(told.square().sum()) * float(expected.square().sum()), 1e-12)


def _groups(points: Annotated[Tensor, "N D"], count: int) -> Annotated[Tensor, "N"]:
    """Index of the nearest of so many centres, which are the means of theirs (k-means), int64."""
    order = points[:, 0].argsort()
    centres = points[order[torch.linspace(0, len(points) - 1, count + 2)[1:-1].long()]].clone()
    for _ in range(_ROUNDS):
        nearest = torch.cdist(points, centres).argmin(1)
        counts = nearest.bincount(minlength=count)[:, None]
        sums = torch.zeros_like(centres).index_add_(0, nearest, points)
        centres = torch.where(counts > 0, sums / counts.clamp_min(1), centres)
    return torch.cdist(points, centres).argmin(1)
