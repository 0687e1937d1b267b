"""Light of the sun and the sky by the sun's elevation. Linear sRGB, relative to white of 6504 K.

Illuminances are those of the Illuminating Engineering Society's recommended practice for the calculation of
daylight availability (1984, doi 10.1080/00994480.1984.10748791), with the sun's height h: on a plane that faces
the sun E = 127.5 exp(-0.21 / sin h) klx; on a level plane from each half of the clear sky 8.2 sin(h)^0.5 klx, but
for a term that the halves have of opposite signs, from each half of an overcast one 10.7 sin(h) klx. The sun's
colour is a black body's of 5778 K behind the extinction of Preetham et al. (1999, appendix 1), with turbidity 2.5:
Rayleigh's 0.008735 w^-4.08, aerosol's (0.04608 turbidity - 0.04586) w^-1.3, ozone's 0.35 cm, w in micrometres.
"""

import math
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..io.images import srgb_to_linear
from .config import Colour, SunConfig, parse_light_colour

_WAVELENGTHS = (0.61, 0.55, 0.465)
"""Micrometres that red, green and blue stand for."""
_OZONE = (0.120, 0.085, 0.008)
"""Absorption of ozone there, a cm."""
_SUN_KELVIN = 5778.0
"""Of the sun above the air."""
_TURBIDITY = 2.5
"""Of clear air, as in Preetham's."""
_CLEAR_KELVIN = 12000.0
"""Of the light of a clear sky, with the sun high (CIE daylight: 10 000 to 25 000)."""
_LOW_CLEAR_KELVIN = 6500.0
"""With the sun at the horizon, whose glow is a part of it; cameras balance blue shade away (by eye)."""
_DUSK_KELVIN = 18000.0
"""Of the sky with the sun below the horizon, blue by ozone (by eye, within the CIE's range)."""
_MOON_KELVIN = 11000.0
"""Of moonlight as eyes see it. It has 4100 K, but faint light looks blue (Jensen et al. 2001; by eye)."""


class Light(NamedTuple):
    """A sun and a sky."""

    sun: Annotated[Tensor, "3"]
    """On a plane that faces the sun."""
    sky: Annotated[Tensor, "3"]
    """On a level plane under the whole sky."""
    horizon: Annotated[Tensor, "3"]
    """Colour of the sky at the horizon, of a mean luma of 1."""
    zenith: Annotated[Tensor, "3"]
    """Colour of the sky overhead; 1 is the mean luma of the sky."""
    brightness: float
    """Of what is lit, as a share of the captured one."""
    elevation: float
    """Degrees of the sun above the horizon."""


def kelvin_colour(kelvin: float) -> Annotated[Tensor, "3"]:
    """Linear sRGB of a black body of luma 1, 1667 to 25 000 K (cubic fit of Kim et al. 2002 to the locus)."""
    t = 1000.0 / kelvin
    if kelvin < 4000:
        x = -0.2661239 * t**3 - 0.2343589 * t**2 + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t**3 + 2.1070379 * t**2 + 0.2226347 * t + 0.240390
    if kelvin < 2222:
        y = -1.1063814 * x**3 - 1.34811020 * x**2 + 2.18555832 * x - 0.20219683
    elif kelvin < 4000:
        y = -0.9549476 * x**3 - 1.37418593 * x**2 + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x**3 - 5.87338670 * x**2 + 3.75112997 * x - 0.37001483
    xyz = torch.tensor([x / y, 1.0, (1 - x - y) / y])
    matrix = torch.tensor(
        [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    )  # IEC 61966-2-1
    return _white(matrix @ xyz)


def sun_colour(elevation: float) -> Annotated[Tensor, "3"]:
    """Linear sRGB of luma 1 of the sun through the air, by its degrees above the horizon."""
    # Kasten's air mass, which stays finite at the horizon.
    mass = 1 / (math.sin(math.radians(elevation)) + 0.15 * (elevation + 3.885) ** -1.253)
    beta = 0.04608 * _TURBIDITY - 0.04586
    parts = []
    for wavelength, ozone in zip(_WAVELENGTHS, _OZONE, strict=True):
        extinction = 0.008735 * wavelength**-4.08 + beta * wavelength**-1.3 + 0.35 * ozone
        parts.append(math.exp(-extinction * mass))
    return _white(kelvin_colour(_SUN_KELVIN) * torch.tensor(parts))


def light_of(config: SunConfig) -> Light:
    """The light of flags."""
    elevation = _elevation_of(config)
    sine = math.sin(math.radians(max(elevation, 0.5)))
    high = min(sine / math.sin(math.radians(30.0)), 1.0)
    sun = 127.5 * math.exp(-0.21 / sine) * sun_colour(max(elevation, 0.5))
    clear = _LOW_CLEAR_KELVIN + (_CLEAR_KELVIN - _LOW_CLEAR_KELVIN) * high
    sky = 2 * 8.2 * sine**0.5 * kelvin_colour(clear)
    zenith = 0.8 * kelvin_colour(_DUSK_KELVIN)
    # Near a low sun's height the sky takes its colour.
    horizon = 1.2 * _white(
        torch.lerp(sun_colour(max(elevation, 2.0)), kelvin_colour(_HIGH_HORIZON_KELVIN), high)
    )
    brightness = 1.0
    if config.light == "overcast":
        sun = torch.zeros(3)
        sky = 2 * 10.7 * sine * torch.ones(3)
        zenith = 1.1 * torch.ones(3)
        horizon = 0.9 * torch.ones(3)
    elif config.light == "blue-hour":
        sun = torch.zeros(3)
        sky = kelvin_colour(_DUSK_KELVIN)
        horizon = 1.3 * kelvin_colour(9000.0)
        brightness = 0.45
    elif config.light == "moonlight":
        sun = 127.5 * math.exp(-0.21 / sine) * kelvin_colour(_MOON_KELVIN)
        sky = 0.2 * _luma(sun) * kelvin_colour(_DUSK_KELVIN)
        zenith = 0.6 * kelvin_colour(_DUSK_KELVIN)
        horizon = 1.1 * kelvin_colour(_DUSK_KELVIN)
        brightness = 0.22
    if config.sun_colour is not None:
        sun = _chosen("sun_colour", config.sun_colour) * _luma(sun)
    if config.sky_colour is not None:
        sky = _chosen("sky_colour", config.sky_colour) * _luma(sky)
    if config.sun_over_sky is not None:
        over = torch.tensor(config.sun_over_sky)
        if config.sky_colour is None:
            # Where the two meet as usual they are white: a camera's balance, and the references' colours.
            sky = _white(1 / (1 + _USUAL_SUN_SHARE * over)) * _luma(sky)
        sun = over * sky
        if config.sun_colour is not None:
            sun = _chosen("sun_colour", config.sun_colour) * _luma(sun)
    return Light(sun, sky, horizon, zenith, brightness, elevation)


def horizon_tint(light: Light) -> Annotated[Tensor, "3"]:
    """Hue of a light's horizon over that of a high sun's; near 1 for one."""
    return _white(light.horizon) / _white(kelvin_colour(_HIGH_HORIZON_KELVIN))


def _elevation_of(config: SunConfig) -> float:
    """Degrees of the sun above the horizon."""
    if config.place is not None:
        return config.place[1]
    if config.sun_elevation is not None:
        return config.sun_elevation
    if config.light is not None:
        return _USUAL_ELEVATIONS[config.light]
    return _PLAIN_ELEVATION


def elevation_of_warmth(warmth: float) -> float:
    """Degrees of the sun above the horizon at which its red over the sky's is so many times its blue over that."""
    degrees = list(range(_LOWEST_WARM_DEGREES, _HIGHEST_WARM_DEGREES + 1))
    away = []
    for elevation in degrees:
        light = light_of(SunConfig(sun=(0.0, float(elevation))))
        over = light.sun / light.sky
        away.append(abs(math.log(float(over[0] / over[2]) / warmth)))
    return float(degrees[away.index(min(away))])


_LOWEST_WARM_DEGREES = 6
"""Lower suns have shadows longer than most captures."""
_HIGHEST_WARM_DEGREES = 50
"""The sun's colour says little about higher ones."""
_PLAIN_ELEVATION = 35.0
"""Degrees above the horizon of a sun that nobody has placed (by eye)."""
_USUAL_SUN_SHARE = 0.4
"""Share of the sun's light on what faces it that surfaces meet in the mean, about (by eye)."""
_USUAL_ELEVATIONS = {
    "noon": 55.0,
    "golden-hour": 8.0,
    "blue-hour": 0.0,
    "overcast": 45.0,
    "moonlight": 40.0,
}
"""Degrees of the sun of each light above the horizon, where no sun is given."""
_HIGH_HORIZON_KELVIN = 7500.0
"""Of the horizon under a high sun (by eye)."""
LUMA = (0.2126, 0.7152, 0.0722)
"""Shares of linear red, green and blue in brightness (IEC 61966-2-1)."""


def _luma(colour: Annotated[Tensor, "3"]) -> float:
    return float(colour @ torch.tensor(LUMA))


def _white(colour: Annotated[Tensor, "3"]) -> Annotated[Tensor, "3"]:
    """The colour at a luma of 1, nothing below 0."""
    colour = colour.clamp_min(0)
    return colour / _luma(colour)


def _chosen(field: str, text: str) -> Annotated[Tensor, "3"]:
    given: Colour | float = parse_light_colour(field, text)
    if isinstance(given, float):
        return kelvin_colour(given)
    return _white(srgb_to_linear(torch.tensor(given)).clamp_min(1e-3))
