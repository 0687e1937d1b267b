"""Another light on Gaussians: what is found out about them once, and their colours under a sun and a sky."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..light.captured import CapturedSun, LogLight, sky_part
from ..light.config import SunConfig
from ..light.relight import LINEAR_OFFSET, Received, affine_change, exposed_gain, gains, sun_share
from ..light.skies import MIN_SKY_HEIGHT, sky_pixels
from ..light.sky import LUMA, Light, horizon_tint, light_of
from ..light.surfaces import Surfaces, find_surfaces
from ..light.transport import (
    Blockers,
    covariances_of,
    disc_directions,
    frame_of,
    openness,
    transport,
)
from ..ops.harmonics import recoloured
from ..ops.rasterise.rendering import Pinhole, lift
from ..rendering.cameras import Cameras
from ..rendering.north import North, world_axes
from .drawing import draw
from .gaussians import Gaussians, bulk_of
from .pinholes import covering
from .restyle import all_around

_VIEWS = 16
"""Views that surfaces are found in."""
_VIEW_PIXELS = 320
"""Longer side of these, at most."""
_MAX_BLOCKER_DISTANCE = 0.5
"""Distance from the bulk (`Bulk.apart`) up to which Gaussians cast shadows: skies and far surroundings lie
farther out, four scenes from within have theirs at 0.6 and more (by eye).
"""
_MIN_SKY_DISTANCE = 2.0
"""Distance of a sky from the bulk of what lies below the horizon, at least: walls of a street reach 1.8."""
_OFFSET_SHARE = 0.008
"""Distance of what casts shadows on a point from it, at least, as a share of the width of the views there: nearer
ones are the surface itself. On the town 0.2 to 0.8 m do alike at 15 m.
"""
_MAX_SPREAD_SHARE = 0.2
"""Distance of a Gaussian from its surface that counts for how thick that is, at most, as a share of that width."""
_MIN_SHOWN_PIXELS = 1e-2
"""Weight of a Gaussian in all views, from which on they say something about it."""
_SOUGHT_AZIMUTHS = 16
"""Places around that are tried for the captured sun, at each elevation."""
_SOUGHT_ELEVATIONS = (30.0, 45.0, 60.0)
"""Degrees above the horizon. Lower ones explain much of towns under clouds, too: what faces them is brighter."""
_MIN_SOUGHT_ELEVATION = 25.0
"""Degrees above the horizon down to which it is sought."""
_SOUGHT_BLOCKERS = 30_000
"""Gaussians that cast shadows in the search, at most: of more, some stand for all."""
_SOUGHT_STEPS = (7.5, 7.5, 3.75)
"""Degrees about the best of these that are tried then."""
_FOLLOWED = 3
"""Places that are followed by these steps: the best of them is not always the nearest."""
_MIN_EVIDENCE = 0.06
"""Evidence of a captured sun (`LogLight.evidence`), at least: cloudy towns stay below (`captured_sun.json`)."""
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
_MIN_LEVEL_NORTH = 0.3
"""Level part of a direction of north, at least: of less nothing is left once it is made level (by eye)."""
_TRIED_ELEVATION = 20.0
"""Degrees above the horizon at which they are tried: between golden hour and noon."""
_TRIED_GAUSSIANS = 8192
"""Gaussians that they are tried on, about."""
_MIN_LIKENESS = 0.6
"""Likeness to the sky of the pixels of a Gaussian of the sky, at least (by eye)."""
MIN_SKY_COLOUR = 0.02
"""Linear light that a captured sky has at least."""
MIN_BLUENESS = 0.2
"""Logarithm of blue over red of a captured sky that counts as blue, at least (by eye)."""
MAX_SKY_GAIN = 4.0
"""Of a sky's linear light (by eye)."""
MAX_HUE_GAIN = 20.0
"""Of a channel of a blue sky that turns grey: its red is so much darker (by eye)."""


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
    beyond: Annotated[Tensor, "N"]
    """Those whose surfaces no shadow falls on, bool: skies, and what lies far out."""
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
        return torch.where(self.beyond, torch.ones(()), found / len(places))

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
        weights = torch.where(self.beyond[some], torch.zeros(()), surfaces.weights)
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
        shown = torch.where(self.beyond, torch.zeros(()), self.surfaces.weights).nonzero()[:, 0]
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

        tried = []
        for elevation in _SOUGHT_ELEVATIONS:
            for azimuth in [k * 360.0 / _SOUGHT_AZIMUTHS for k in range(_SOUGHT_AZIMUTHS)]:
                tried.append((evidence(azimuth, elevation), azimuth, elevation))
        followed = sorted(tried, reverse=True)[:_FOLLOWED]
        most, azimuth, elevation = max(_followed(start, evidence) for start in followed)
        if most < _MIN_EVIDENCE:
            return None
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
                gain[self.sky] = self.sky_gain(light)
        return 1 + config.sun_strength * (gain - 1)

    def sky_gain(self, light: Light) -> Annotated[Tensor, "S 3"]:
        """Factors of colours + 0.055 that give the captured sky, in the mean at each height, the light's own colours.

        Where the captured sky is bluer than these, clouds and what is between them take one hue: of both only the
        brightness stays. Else clouds would turn as much more orange as the blue turns grey.
        """
        height = self.heights[self.sky].clamp(0, 1)[:, None]
        captured = self.captured_sky
        mean = captured.mean_at(height)
        horizon, zenith = captured.colours_in(light)
        wanted = torch.lerp(horizon, zenith, height.sqrt())
        own = (self.colours[self.sky].clamp(0, 1) + LINEAR_OFFSET).pow(2.4)
        luma = torch.tensor(LUMA)
        brighter = ((own @ luma) / (mean @ luma))[:, None]
        one_hue = (wanted * brighter / own.clamp_min(MIN_SKY_COLOUR)).clamp_max(MAX_HUE_GAIN)
        blue = blueness(mean)
        share = ((blue - blueness(wanted)) / blue.clamp_min(MIN_BLUENESS)).clamp(0, 1)[:, None]
        kept = (wanted / mean).clamp_max(MAX_SKY_GAIN)
        gain: Tensor = torch.exp(torch.lerp(kept.log(), one_hue.log(), share) / 2.4)
        return gain

    @cached_property
    def captured_sky(self) -> "CapturedSky":
        """Colours of the captured sky by height."""
        height = self.heights[self.sky].clamp(0, 1)
        linear = (self.colours[self.sky].clamp(0, 1) + LINEAR_OFFSET).pow(2.4)
        weight = (self.surfaces.weights[self.sky] + 1e-6)[:, None]
        rows = torch.stack([torch.ones_like(height), height], 1)
        fit = torch.linalg.lstsq((rows * weight.sqrt()).double(), (linear * weight.sqrt()).double()).solution
        found = CapturedSky(fit.float(), 0.0)
        mean = found.mean_at(height[:, None])
        return found._replace(brightness=float((mean * weight).sum() / (3 * weight.sum())))


Reach: TypeAlias = Callable[[Annotated[Tensor, "3"], float], Annotated[Tensor, "N"]]
"""Share of a sun's light that reaches each Gaussian, by its direction and its degrees."""


class CapturedSky(NamedTuple):
    """The sky as captured, in linear light."""

    fit: Annotated[Tensor, "2 3"]
    """Colour at the horizon, and what the height adds to it."""
    brightness: float

    def mean_at(self, height: Annotated[Tensor, "S 1"]) -> Annotated[Tensor, "S 3"]:
        """Colours at sines of heights in [0, 1]."""
        return (self.fit[0] + height * self.fit[1]).clamp_min(MIN_SKY_COLOUR)

    def colours_in(self, light: Light) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
        """Colours of the sky at the horizon and overhead in another light. A clear sky that was captured bluer than the
        light's stays as it is in the sun, but for what a low sun makes of the horizon.
        """
        own = self.mean_at(torch.tensor([[0.0], [1.0]]))
        if bool(light.sun.any()) and float(blueness(own[1])) > float(blueness(light.zenith)):
            return light.brightness * own[0] * horizon_tint(light), light.brightness * own[1]
        level = self.level(light)
        return level * light.horizon, level * light.zenith

    def level(self, light: Light) -> float:
        """Brightness in another light: the sky stays as bright as it is, but for what the light asks."""
        level = light.brightness * self.brightness
        if bool(light.sun.any()):
            level *= _CLEAR_SKY_SHARE
        return level


def blueness(colour: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "..."]:
    """Logarithm of blue over red of linear light."""
    return (colour[..., 2] / colour[..., 0]).log()


_CLEAR_SKY_SHARE = 0.75
"""Brightness of a clear sky over that of clouds, in pictures (by eye)."""


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
        beyond=kept.beyond[rows],
        sky=kept.sky[rows],
        heights=kept.heights[rows],
        colours=kept.colours[rows],
    )


@torch.inference_mode()
def find_illumination(
    gaussians: Gaussians, cameras: Cameras, *, antialiased: bool, near: float
) -> Illumination:
    """Find surfaces, the sky and openness from views."""
    up, ahead = world_axes(cameras)
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
    count = min(_VIEWS, len(cameras))
    chosen = cameras.select(torch.linspace(0, len(cameras) - 1, count).round().long())
    chosen = chosen.scaled(max(1.0, float(chosen.size.amax()) / _VIEW_PIXELS))
    pinholes = [covering(chosen, view, near) for view in range(count)]
    surfaces = find_surfaces(*shape, pinholes, up=up, antialiased=antialiased)
    bulk = bulk_of(gaussians.means.numpy())
    far = torch.from_numpy(bulk.apart > _MAX_BLOCKER_DISTANCE)
    eyes = cameras.pose[:, :, 3].float().mean(0)
    heights = torch.nn.functional.normalize(gaussians.means - eyes, dim=1) @ up
    above = heights > MIN_SKY_HEIGHT
    far = far | (above & _behind_ground(gaussians.means, ~above))
    sky = far & above
    # Half of the views tell as much: on the town all of them are 0.02 dB worse, and take 0.6 s more for a plant.
    like, followed, spread = _seen_again(gaussians, surfaces, far, sky, pinholes[::2], up, antialiased)
    far = far | sky | ((like > _MIN_LIKENESS) & above)
    sky = sky | ((torch.maximum(like, followed) > _MIN_LIKENESS) & above)
    # A training may put bare asphalt far too deep; its surface is where the markings around are.
    beyond = sky | torch.from_numpy(bulk.distances(surfaces.points.numpy()) > _MAX_BLOCKER_DISTANCE)
    covariances = covariances_of(gaussians.quaternions, gaussians.log_scales)
    blockers = Blockers(gaussians.means[~far], covariances[~far], gaussians.opacities[~far])
    found = Illumination(
        surfaces,
        blockers,
        spread,
        torch.ones(len(gaussians)),
        far,
        beyond,
        sky,
        heights,
        up,
        ahead,
        gaussians.colours,
    )
    open_ = openness(blockers, found.points, surfaces.normals, up, found.offset, found.offset, found.blur)
    return replace(found, openness=torch.where(beyond, torch.ones(()), open_))


def _behind_ground(means: Annotated[Tensor, "N 3"], below: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """What lies far outside of all that is below the horizon, bool: where a third of a capture's Gaussians are of the
    sky, they count for its bulk.
    """
    if not bool(below.any()):
        return below
    ground = bulk_of(means[below].numpy())
    return torch.from_numpy(ground.distances(means.numpy()) > _MIN_SKY_DISTANCE)


def _seen_again(
    gaussians: Gaussians,
    surfaces: Surfaces,
    far: Annotated[Tensor, "N"],
    sky: Annotated[Tensor, "N"],
    cameras: Sequence[Pinhole],
    up: Annotated[Tensor, "3"],
    antialiased: bool,
) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N"], Annotated[Tensor, "N"]]:
    """Both likenesses to the sky of the pixels that show a Gaussian (`sky_pixels`), in [0, 1], and the thickness of the
    surface there: the mean distance of what they show from it.
    """
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
    away = ((surfaces.points - gaussians.means) * surfaces.normals).sum(1).abs()
    away = torch.minimum(away, _MAX_SPREAD_SHARE * surfaces.widths)
    values = torch.stack([sky.float(), torch.where(far, torch.zeros(()), away)], 1)
    sums = torch.zeros(len(gaussians), 4)
    for camera in cameras:
        drawn = draw(gaussians, camera, antialiased=antialiased, features=values)
        inside = drawn.features / drawn.opacity.clamp_min(1e-3)[..., None]
        sure = torch.where(drawn.opacity > 0.5, inside[..., 0], torch.zeros(()))
        like, followed = sky_pixels(drawn.image.clamp(0, 1), sure, camera, up)
        pixels = torch.stack([like, followed, inside[..., 1], torch.ones_like(like)], -1)
        sums += lift(*shape, camera, pixels.contiguous(), antialiased=antialiased)
    found = sums[:, :3] / sums[:, 3:].clamp_min(_MIN_SHOWN_PIXELS)
    return found[:, 0], found[:, 1], found[:, 2]


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
    there = torch.tensor(north.direction)
    level = there - (there @ illumination.up) * illumination.up
    if float(level.norm()) < _MIN_LEVEL_NORTH:
        return illumination
    level = torch.nn.functional.normalize(level, dim=0)
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
