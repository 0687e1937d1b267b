"""Light on Gaussians as the page computes it (`web/sun.js`), by the formulas of `fprf/light/relight.py`.

Bytes of N packed Gaussians:

level    how far a surface faces the sky; of the sky the sine of its height
open     share of the sky's light that comes to it (`relight.sky_share`), at least 13; 0 = it belongs to the sky
met      of one light: share of the sun's light that meets it

A light has few numbers beside its bytes: what of the sun, the sky and the ground falls on a surface, each times the
exposure. Two lights are blended by these numbers and bytes: linear in irradiance.
"""

import zlib
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..light.captured_sky import MAX_HUE_GAIN, MAX_SKY_GAIN, MIN_BLUENESS, MIN_SKY_COLOUR
from ..light.config import SunConfig
from ..light.day import day
from ..light.relight import (
    GROUND_ALBEDO,
    MAX_GAIN,
    SHOULDER,
    bounced,
    exposure_of,
    level_share,
    sky_share,
    sun_share,
)
from ..splats.relighting import Illumination, Reach


@dataclass(frozen=True, eq=False)
class PackedLight:
    """A light; where it has no sun nothing is met."""

    met: Annotated[NDArray[np.uint8], "N"] | None
    head: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Suns:
    """Lights of a day on N Gaussians, and that of clouds."""

    surfaces: Annotated[NDArray[np.uint8], "2 N"]
    head: dict[str, Any]
    day: tuple[PackedLight, ...]
    overcast: PackedLight

    def section(self, rows: Annotated[Tensor, "n"], level: int = 9) -> bytes:
        """Deflated bytes of some Gaussians: level, open, and met of each light that has a sun."""
        planes = [*self.surfaces, *(light.met for light in self.day if light.met is not None)]
        chosen = rows.numpy()
        return zlib.compress(b"".join(plane[chosen].tobytes() for plane in planes), level)

    @property
    def header(self) -> dict[str, Any]:
        """Header of the section, for the page."""
        return {
            **self.head,
            "day": [light.head for light in self.day],
            "overcast": self.overcast.head,
        }


def packed_surfaces(illumination: Illumination) -> Annotated[NDArray[np.uint8], "2 N"]:
    """Bytes of all Gaussians, whatever the light: level and open."""
    received = illumination.received
    level = torch.where(
        illumination.sky, illumination.heights.clamp(0, 1), level_share(received, illumination.up)
    )
    opened = torch.where(illumination.sky, torch.zeros(()), sky_share(received))
    return _bytes(torch.stack([level, opened]))


def surfaces_header(illumination: Illumination) -> dict[str, Any]:
    """Data of surfaces for the page, whatever the light."""
    fit = None
    if bool(illumination.sky.any()):
        fit = illumination.captured_sky.fit.tolist()
    return {
        "ahead": illumination.zero.tolist(),
        "north": illumination.north is not None,
        "first": illumination.view_azimuth,
        "fit": fit,
        "shoulder": SHOULDER,
        "albedo": GROUND_ALBEDO,
        "most": MAX_GAIN,
        "mostSky": MAX_SKY_GAIN,
        "leastSky": MIN_SKY_COLOUR,
        "leastBlue": MIN_BLUENESS,
        "mostHue": MAX_HUE_GAIN,
    }


def packed_light(illumination: Illumination, config: SunConfig, reach: Reach | None = None) -> PackedLight:
    """A light as the page draws it; `reach` takes the place of `illumination.reach`. Its strength is left to the
    page.
    """
    light, sun, received = illumination.under(config, reach)
    exposure = exposure_of(received, light, sun, illumination.up, illumination.colours, illumination.metered)
    horizon = light.horizon
    zenith = light.zenith
    if bool(illumination.sky.any()):
        horizon, zenith = illumination.captured_sky.colours_in(light)
    head: dict[str, Any] = {
        "sun": (exposure * light.sun).tolist(),
        "sky": (exposure * light.sky).tolist(),
        "bounce": (exposure * bounced(light, sun, illumination.up)).tolist(),
        "horizon": horizon.tolist(),
        "zenith": zenith.tolist(),
    }
    if config.sun == "auto" and bool(illumination.sky.any()):
        # The sky stays as it is, but for what lies between a root and a line.
        captured = illumination.captured_sky.fit
        head["horizon"] = captured[0].tolist()
        head["zenith"] = captured.sum(0).tolist()
    met = None
    if bool(light.sun.any()):
        met = _bytes(sun_share(received, sun))
        head["at"] = illumination.degrees_of(sun)
    return PackedLight(met, head)


def packed_day(illumination: Illumination, suns: int) -> Suns:
    """A day with so many suns."""
    lights = []
    for hour in day(suns, illumination.noon, clockwise=illumination.clockwise):
        light = packed_light(illumination, hour.config)
        place = {"hour": hour.hour, "at": [hour.azimuth, hour.elevation], "met": light.met is not None}
        lights.append(PackedLight(light.met, {**light.head, **place}))
    overcast = packed_light(illumination, SunConfig(light="overcast"))
    surfaces = packed_surfaces(illumination)
    return Suns(surfaces, surfaces_header(illumination), tuple(lights), overcast)


def _bytes(share: Tensor) -> NDArray[np.uint8]:
    """Shares in [0, 1] in steps of 1/255."""
    rounded: NDArray[np.uint8] = (255 * share.clamp(0, 1)).round().to(torch.uint8).numpy()
    return rounded
