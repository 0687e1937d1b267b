"""Light that falls on a scene of Gaussians, as flags say it. No torch."""

import re
from dataclasses import dataclass
from typing import Literal

from ..checks import between
from ..errors import ConfigError

LightName = Literal["noon", "golden-hour", "blue-hour", "overcast", "moonlight"]
MIN_KELVIN = 1667.0
"""Lowest colour temperature that the formula for black bodies holds for."""
MAX_KELVIN = 25000.0
"""Highest one."""
_HEX = re.compile(r"#?([0-9a-fA-F]{6})")
_KELVIN = re.compile(r"(\d+(?:\.\d+)?)K?")

Colour = tuple[float, float, float]


def parse_light_colour(field: str, text: str) -> Colour | float:
    """`#RRGGBB`, sRGB in [0, 1], or a colour temperature such as `3500` or `3500K`. Raises ConfigError."""
    found = _KELVIN.fullmatch(text)
    if found and not text.startswith("#") and float(found[1]) <= MAX_KELVIN:
        between(field, float(found[1]), MIN_KELVIN, MAX_KELVIN)
        return float(found[1])
    found = _HEX.fullmatch(text)
    if found is None:
        raise ConfigError(
            f"{field}: {text!r} is no colour; write #RRGGBB or kelvin, for example #ffd9a0 or 3500K"
        )
    parts = []
    for at in (0, 2, 4):
        parts.append(int(found[1][at : at + 2], 16) / 255)
    return (parts[0], parts[1], parts[2])


@dataclass(frozen=True, kw_only=True)
class SunConfig:
    """A sun and a sky, for Gaussians alone."""

    light: LightName | None = None
    """Light that falls on the scene in the place of the captured one, by a time of day; none = as captured, or
    that of a clear sky where `sun` is given.
    """
    sun: tuple[float, float] | Literal["auto"] | None = None
    """AZIMUTH ELEVATION of the sun in degrees: clockwise from where `sun_from` says, in [-360, 360], and above
    the horizon, in [0.5, 90]. none = at the height of `light`, on the side from which most of what the
    views show is lit. auto = there, too, with the colour, strength and softness that the references show in the sun
    and in the shade; where they don't tell, the light is as without it.
    """
    sun_from: Literal["north", "view"] = "north"
    """Direction that the azimuth of `sun` counts from: north, and of a scene of which nothing tells it the direction of
    the first view; view = that of the first view in any case.
    """
    sun_elevation: float | None = None
    """Degrees of the sun above the horizon, in [0.5, 90], where `sun` does not say; none = as the light has it."""
    sun_over_sky: tuple[float, float, float] | None = None
    """Light of the sun on what faces it over that of the sky on what is level, in red, green and blue, each in
    [0, 50]: the more, the darker are shadows. none = by the sun's elevation.
    """
    sun_strength: float = 1.0
    """Share of this light in the place of the captured one, in [0, 1]: at 0 colours stay bit for bit."""
    sun_colour: str | None = None
    """Colour of the sun: #RRGGBB, or kelvin such as 3500K. none = by its elevation."""
    sky_colour: str | None = None
    """Colour of the sky's light: #RRGGBB, or kelvin such as 9000K. none = as the light says."""
    unlit: bool = False
    """Take the sun that the capture was taken in, where one is found, out of its colours first; without `light` and
    `sun` nothing else changes.
    """
    sun_size: float = 0.53
    """Diameter of the sun in degrees, in [0, 5]: the larger, the softer are shadows far from what casts them."""

    def __post_init__(self) -> None:
        if isinstance(self.sun, str):
            self._check_auto()
        elif self.sun is not None:
            between("sun", self.sun[0], -360.0, 360.0)
            between("sun", self.sun[1], 0.5, 90.0)
        if self.sun_elevation is not None:
            between("sun_elevation", self.sun_elevation, 0.5, 90.0)
        for share in self.sun_over_sky or ():
            between("sun_over_sky", share, 0.0, 50.0)
        between("sun_strength", self.sun_strength, 0.0, 1.0)
        between("sun_size", self.sun_size, 0.0, 5.0)
        for name in ("sun_colour", "sky_colour"):
            text = getattr(self, name)
            if text is not None:
                parse_light_colour(name, text)

    def _check_auto(self) -> None:
        """Raise ConfigError for another word than auto, and for lights without a sun beside it."""
        if self.sun != "auto":
            raise ConfigError(
                f"sun: {self.sun!r} is no place; write azimuth and elevation, for example -60 25, or auto"
            )
        if self.light in ("overcast", "blue-hour"):
            raise ConfigError(
                f"sun: auto needs a light with a sun, {self.light} has none; leave one of them out"
            )

    @property
    def place(self) -> tuple[float, float] | None:
        """Azimuth and elevation that are asked for in degrees; None = found."""
        if isinstance(self.sun, str):
            return None
        return self.sun

    @property
    def light_asked(self) -> bool:
        """A light other than the captured one is asked for, at whatever strength."""
        return self.light is not None or self.sun is not None or self.unlit

    @property
    def light_name(self) -> str:
        """A name of the light for files: that of the light, or where the sun stands; empty without one."""
        if self.light is not None:
            return self.light
        if self.place is not None:
            return f"sun-{self.place[0]:g}-{self.place[1]:g}"
        if self.sun is not None:
            return "sun-auto"
        if self.unlit:
            return "unlit"
        return ""

    @property
    def lit(self) -> bool:
        """It changes colours."""
        return self.light_asked and self.sun_strength > 0
