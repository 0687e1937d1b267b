"""Another light on Gaussians: their colours under a sun and a sky, from what `find_light` finds out about them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..light.captured import CapturedSun, LogLight, sky_part, sought
from ..light.captured_sky import CapturedSky, fitted_sky
from ..light.config import SunConfig
from ..light.relight import LINEAR_OFFSET, Received, affine_change, exposed_gain, gains, sun_share
from ..light.sky import Light, light_of
from ..light.surfaces import Surfaces
from ..light.transport import Blockers, disc_directions, frame_of, transport
from ..ops.harmonics import recoloured
from ..rendering.north import North, level_direction
from .restyle import all_around

_OFFSET_SHARE = 0.008
"""Distance of what casts shadows on a point from it, at least, as a share of the width of the views there: nearer
ones are the surface itself. On the town 0.2 to 0.8 m do alike at 15 m.
"""
_SOUGHT_BLOCKERS = 30_000
"""Gaussians that cast shadows in the search, at most: of more, some stand for all."""
_MIN_TRIED_GAUSSIANS = 500
"""Gaussians that tell a captured sun."""
_LIFT_SHARE = 0.4
"""Of that distance, by which points are moved out along their normals."""
_BLUR_SHARE = 0.0008
"""Deviation by which Gaussians are widened across the light, as a share of the same width at the median: thinner
than a quarter of a pixel they would hit or miss.
"""
_SUN_PLACES = 4
"""Places on the disc of a sun that is larger than a degree: each takes as long as a small sun."""
_MAX_HARD_DEGREES = 1.0
"""Diameter up to which a sun is one place: its shadows are blurred by a sixtieth of their distance at most."""
_AZIMUTHS = 8
"""Places around that are tried for a sun that nobody has placed."""
_TRIED_ELEVATION = 20.0
"""Degrees above the horizon at which they are tried: between golden hour and noon."""
_TRIED_GAUSSIANS = 8192
"""Gaussians that they are tried on, about."""


@dataclass(frozen=True, eq=False)
class Illumination:
    """Surfaces, shadows and sky of N Gaussians, for light from any direction."""

    surfaces: Surfaces
    blockers: Blockers
    spread: Annotated[Tensor, "N"]
    """Thickness of the surface: mean distance from it of what is seen with it."""
    openness: Annotated[Tensor, "N"]
    far: Annotated[Tensor, "N"]
    """Gaussians that cast no shadows, bool."""
    sky: Annotated[Tensor, "N"]
    """Those of the sky, bool."""
    heights: Annotated[Tensor, "N"]
    """Sines of their heights above the horizon, as the cameras see them."""
    up: Annotated[Tensor, "3"]
    ahead: Annotated[Tensor, "3"]
    """Level direction of the first view."""
    colours: Annotated[Tensor, "N 3"]
    """As captured, mean over directions, sRGB."""
    known_sun: tuple[CapturedSun | None, ...] = ()
    """The sun of the capture, where it was sought before; () = it is sought when it is first asked for."""
    north: Annotated[Tensor, "3"] | None = None
    """Level direction of north, where it is known."""
    southern: bool | None = None
    """The scene lies south of the equator, where that is known."""

    @property
    def points(self) -> Annotated[Tensor, "N 3"]:
        """Points just above the surfaces."""
        away = _LIFT_SHARE * _OFFSET_SHARE * self.surfaces.widths
        return self.surfaces.points + away[:, None] * self.surfaces.normals

    @property
    def offset(self) -> Annotated[Tensor, "N"]:
        """Distance up to which what takes light away is the surface itself."""
        return torch.maximum(_OFFSET_SHARE * self.surfaces.widths, self.spread)

    @property
    def blur(self) -> float:
        """Deviation by which blockers are widened."""
        return _BLUR_SHARE * float(self.surfaces.widths.median())

    @property
    def zero(self) -> Annotated[Tensor, "3"]:
        """Level direction of azimuth 0: north, or where that is not known the first view's."""
        return self.ahead if self.north is None else self.north

    @property
    def view_azimuth(self) -> float:
        """Azimuth of the first view's direction in degrees."""
        return self.degrees_of(self.ahead)[0]

    def sun_direction(self, azimuth: float, elevation: float) -> Annotated[Tensor, "3"]:
        """Unit vector to a sun at degrees clockwise from azimuth 0, and above the horizon."""
        right = torch.linalg.cross(self.zero, self.up)
        turn = math.radians(azimuth)
        rise = math.radians(elevation)
        level = math.cos(turn) * self.zero + math.sin(turn) * right
        sun: Tensor = math.cos(rise) * level + math.sin(rise) * self.up
        return sun

    def degrees_of(self, sun: Annotated[Tensor, "3"]) -> tuple[float, float]:
        """Azimuth in [-180, 180] and elevation of a unit vector, as `sun_direction` takes them."""
        right = torch.linalg.cross(self.zero, self.up)
        azimuth = math.degrees(math.atan2(float(sun @ right), float(sun @ self.zero)))
        return azimuth, math.degrees(math.asin(max(-1.0, min(1.0, float(sun @ self.up)))))

    def reach(self, sun: Annotated[Tensor, "3"], degrees: float = 0.0) -> Annotated[Tensor, "N"]:
        """Share of the light of a sun of so many degrees that reaches each Gaussian, in [0, 1]."""
        points = self.points
        offset = self.offset
        places = sun[None]
        if degrees > _MAX_HARD_DEGREES:
            places = disc_directions(sun, self.up, degrees, _SUN_PLACES)
        found = torch.zeros(len(points))
        for place in places:
            found += transport(self.blockers, points, frame_of(place, self.up), offset, offset, self.blur)
        return torch.where(self.sky, torch.ones(()), found / len(places))

    @cached_property
    def azimuth(self) -> float:
        """Degrees clockwise from azimuth 0 from which a sun lights most of what the views show."""
        return self._most_lit([k * 360.0 / _AZIMUTHS for k in range(_AZIMUTHS)])

    @cached_property
    def noon(self) -> float:
        """Azimuth of the sun at noon: south or north where these are known, else as `azimuth`. On which side of the
        equator a scene lies decides, else which of the two lights more.
        """
        if self.north is None:
            return self.azimuth
        if self.southern is None:
            return self._most_lit([180.0, 0.0])
        return 0.0 if self.southern else 180.0

    @property
    def clockwise(self) -> bool:
        """The sun goes clockwise in a day, as seen from above: not where it stands in the north at noon."""
        return self.north is None or self.noon != 0

    def _most_lit(self, azimuths: Sequence[float]) -> float:
        """The one of some azimuths, the first of equals, from which most of what the views show is lit."""
        some = slice(None, None, max(1, len(self.far) // _TRIED_GAUSSIANS))
        surfaces = Surfaces(*(part[some] for part in self.surfaces))
        weights = torch.where(self.sky[some], torch.zeros(()), surfaces.weights)
        points = self.points[some]
        offset = self.offset[some]
        best = azimuths[0]
        most = -1.0
        for azimuth in azimuths:
            sun = self.sun_direction(azimuth, _TRIED_ELEVATION)
            reach = transport(self.blockers, points, frame_of(sun, self.up), offset, offset, self.blur)
            received = Received(surfaces.normals, surfaces.sure, self.openness[some], reach)
            lit = float(sun_share(received, sun) @ weights)
            if lit > most:
                best = azimuth
                most = lit
        return best

    @cached_property
    def captured_sun(self) -> CapturedSun | None:
        """The sun of the capture; None under clouds and in the shade."""
        if self.known_sun:
            return self.known_sun[0]
        every = math.ceil(len(self.far) / _SOUGHT_BLOCKERS)
        if every == 1:
            return self._sought_sun()
        return thinned(self, torch.arange(0, len(self.far), every), every)._sought_sun()

    def _sought_sun(self) -> CapturedSun | None:
        shown = torch.where(self.sky, torch.zeros(()), self.surfaces.weights).nonzero()[:, 0]
        if len(shown) < _MIN_TRIED_GAUSSIANS:
            return None
        # By what the views show of them, and so evenly over pictures.
        weight = self.surfaces.weights[shown].double().cumsum(0)
        wanted = (torch.arange(_TRIED_GAUSSIANS) + 0.5) / _TRIED_GAUSSIANS * weight[-1]
        place = torch.searchsorted(weight, wanted).clamp_max(len(shown) - 1)
        some = shown[torch.from_numpy(np.unique(place.numpy()))]
        received = Received(*(part[some] for part in self.received))
        log_light = LogLight(self.colours[some], received, self.surfaces.points[some], self.up)

        def evidence(azimuth: float, elevation: float) -> float:
            return log_light.evidence(self._sun_over_sky(some, self.sun_direction(azimuth, elevation)))

        found = sought(evidence)
        if found is None:
            return None
        azimuth, elevation = found
        ratio = self._sun_over_sky(some, self.sun_direction(azimuth, elevation))
        return CapturedSun(
            (azimuth + 180) % 360 - 180, elevation, log_light.explained(ratio), log_light.strengths(ratio)
        )

    def _sun_over_sky(
        self, rows: Annotated[Tensor, "n"] | slice, sun: Annotated[Tensor, "3"]
    ) -> Annotated[Tensor, "n"]:
        """Share of a sun's light that meets some Gaussians over that of the sky's."""
        offset = self.offset[rows]
        reach = transport(self.blockers, self.points[rows], frame_of(sun, self.up), offset, offset, self.blur)
        received = Received(*(part[rows] for part in self.received))._replace(reach=reach)
        return sun_share(received, sun) / sky_part(received, self.up)

    @cached_property
    def unlit_gain(self) -> Annotated[Tensor, "N 3"]:
        """Factors of colours + 0.055 that take the captured sun away; 1 where there is none."""
        sun = self.captured_sun
        if sun is None:
            return torch.ones(len(self.far), 3)
        ratio = self._sun_over_sky(slice(None), self.sun_direction(sun.azimuth, sun.elevation))
        change = 1 / (1 + sun.strength * ratio[:, None])
        change = torch.where(self.sky[:, None], torch.ones(()), change)
        return exposed_gain(change, self.colours, self.metered, 1.0)

    @property
    def metered(self) -> Annotated[Tensor, "N"]:
        """Pixels that all but the sky weigh in the views."""
        return torch.where(self.sky, torch.zeros(()), self.surfaces.weights)

    @property
    def received(self) -> Received:
        """Light on all Gaussians, but for that of the sun."""
        none = torch.zeros(len(self.far))
        return Received(self.surfaces.normals, self.surfaces.sure, self.openness, none)

    def under(
        self, config: SunConfig, reach: "Reach | None" = None
    ) -> tuple[Light, Annotated[Tensor, "3"], Received]:
        """A light, the unit vector to its sun, and what all Gaussians receive; `reach` takes the place of that of
        this illumination.
        """
        light = light_of(config)
        azimuth = 0.0
        if config.place is not None:
            azimuth = config.place[0]
            if config.sun_from == "view":
                azimuth += self.view_azimuth
        elif bool(light.sun.any()):
            azimuth = self.azimuth
        sun = self.sun_direction(azimuth, light.elevation)
        received = self.received
        if bool(light.sun.any()):
            received = received._replace(reach=(reach or self.reach)(sun, config.sun_size))
        return light, sun, received

    def gain(self, config: SunConfig) -> Annotated[Tensor, "N 3"]:
        """Factors of colours + 0.055 in a light."""
        gain = torch.ones_like(self.colours)
        if config.unlit:
            gain = self.unlit_gain
        if config.light is not None or config.sun is not None:
            light, sun, received = self.under(config)
            colours = gain * (self.colours + LINEAR_OFFSET) - LINEAR_OFFSET
            gain = gain * gains(received, light, sun, self.up, colours, self.metered)
            if config.sun == "auto":
                # The sky keeps the colours of the references, which show it in that light.
                gain[self.sky] = 1.0
            elif bool(self.sky.any()):
                gain[self.sky] = self.captured_sky.gain(self.colours[self.sky], self.heights[self.sky], light)
        return 1 + config.sun_strength * (gain - 1)

    @cached_property
    def captured_sky(self) -> CapturedSky:
        """Colours of the captured sky by height."""
        sky = self.sky
        return fitted_sky(self.colours[sky], self.heights[sky], self.surfaces.weights[sky])


Reach: TypeAlias = Callable[[Annotated[Tensor, "3"], float], Annotated[Tensor, "N"]]
"""Share of a sun's light that reaches each Gaussian, by its direction and its degrees."""


def thinned(illumination: Illumination, rows: Annotated[Tensor, "n"], every: int) -> Illumination:
    """The illumination of some rows alone, one of `every` neighbours, each as much larger where it casts shadows."""
    kept = illumination
    # Rows of the blockers, which are those that are not far.
    place = (~kept.far).cumsum(0) - 1
    some = place[rows[~kept.far[rows]]]
    means, covariances, opacities = kept.blockers
    blockers = Blockers(means[some], every * covariances[some], opacities[some])
    surfaces = Surfaces(*(part[rows] for part in kept.surfaces))
    return replace(
        kept,
        surfaces=surfaces,
        blockers=blockers,
        spread=kept.spread[rows],
        openness=kept.openness[rows],
        far=kept.far[rows],
        sky=kept.sky[rows],
        heights=kept.heights[rows],
        colours=kept.colours[rows],
    )


def relit_harmonics(
    harmonics: Annotated[Tensor, "N K 3"], gain: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N K 3"]:
    """Harmonics whose colours + 0.055 are multiplied, from every direction."""
    weight = torch.ones(len(harmonics))
    return recoloured(harmonics, affine_change(gain), weight, all_around(harmonics.shape[1]))


def mixed_gain(
    illumination: Illumination, parts: Sequence[tuple[float, SunConfig | None]]
) -> Annotated[Tensor, "N 3"]:
    """The gain of lights that are mixed by shares; None is the captured one."""
    total = torch.zeros_like(illumination.colours)
    for share, config in parts:
        total += share * (1.0 if config is None else illumination.gain(config))
    return total


def facing_north(illumination: Illumination, north: North | None) -> Illumination:
    """An illumination whose azimuths count from north, where that is known."""
    if north is None:
        return illumination
    level = level_direction(torch.tensor(north.direction), illumination.up)
    if level is None:
        return illumination
    turned = replace(illumination, north=level, southern=north.southern)
    suns = []
    for sun in illumination.known_sun:
        if sun is not None:
            direction = illumination.sun_direction(sun.azimuth, sun.elevation)
            sun = sun._replace(azimuth=turned.degrees_of(direction)[0])
        suns.append(sun)
    return replace(turned, known_sun=tuple(suns))


def azimuth_note(north: North | None, lights: Sequence[SunConfig | None]) -> str:
    """One line that says what azimuths of suns count from."""
    if north is None:
        return "azimuths count from the direction of the first view, as nothing tells where north lies"
    note = f"azimuths count from north: {north.source}"
    if any(light is not None and light.place is not None and light.sun_from == "view" for light in lights):
        return f"{note}; that of --sun from the direction of the first view"
    return note


def captured_light_note(sun: CapturedSun | None, *, unlit: bool) -> str:
    """One line that says what light a capture was taken in, and whether its shadows stay."""
    if sun is None:
        return "light as captured: clouds or shade" + (", so --unlit changes nothing" if unlit else "")
    where = f"sun from azimuth {sun.azimuth:.0f}, elevation {sun.elevation:.0f}"
    share = f"explains {100 * sun.explained:.0f} % of how brightness varies"
    if unlit:
        return f"light as captured: {where} ({share}); it is taken away as far as it was found"
    return f"light as captured: {where} ({share}); its shadows stay, but for --unlit true"
