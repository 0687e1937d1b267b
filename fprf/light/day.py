"""A day: where the sun stands from dawn to dusk. No torch.

The sun goes along a great circle, clockwise as seen from above or, south of the equator, the other way round, and
stands highest at 12 o'clock. An hour turns it by 15 degrees.
"""

import math
from typing import NamedTuple

from ..errors import ConfigError
from .config import SunConfig

MIN_SUNS = 2
"""Suns of a day, at least: a first and a last one."""
MAX_SUNS = 64
"""At most: they are two and a half degrees apart then."""

_NOON_ELEVATION = 55.0
"""Degrees above the horizon at 12 o'clock, as of the light `noon`."""
_LOWEST_SUN_TURN = 80.0
"""Degrees before and after noon of the first and the last sun: 8 degrees above the horizon, as of
`golden-hour`.
"""
_DUSK_TURN = 100.0
"""Degrees before and after noon of the blue hours, with the sun 8 degrees below the horizon."""
_DEGREES_PER_HOUR = 15.0
"""Of the earth's turn."""


def check_suns(count: int) -> None:
    """Raise ConfigError for a number of suns that a page cannot have."""
    if count and not MIN_SUNS <= count <= MAX_SUNS:
        raise ConfigError(f"suns: {count} must be 0, or lie in [{MIN_SUNS}, {MAX_SUNS}]")


class Hour(NamedTuple):
    """A light of a day."""

    hour: float
    """In [0, 24)."""
    azimuth: float
    elevation: float
    """Of the sun in degrees; below 0 it is under the horizon."""
    config: SunConfig


def day(suns: int, noon: float, *, clockwise: bool = True) -> list[Hour]:
    """Blue hour, so many suns at even steps, blue hour; `noon` is the azimuth of the highest sun in degrees."""
    turns = [-_DUSK_TURN]
    for k in range(suns):
        turns.append(_LOWEST_SUN_TURN * (2 * k / (suns - 1) - 1))
    turns.append(_DUSK_TURN)
    hours = []
    for turn in turns:
        azimuth, elevation = sun_at(turn, noon, clockwise=clockwise)
        config = SunConfig(light="blue-hour")
        if elevation > 0:
            config = SunConfig(sun=(azimuth, elevation))
        hours.append(Hour(12 + turn / _DEGREES_PER_HOUR, azimuth, elevation, config))
    return hours


def sun_at(turn: float, noon: float, *, clockwise: bool = True) -> tuple[float, float]:
    """Azimuth in [-180, 180) and elevation in degrees of the sun, `turn` degrees after noon."""
    highest = math.radians(_NOON_ELEVATION)
    across = math.sin(math.radians(turn if clockwise else -turn))
    along = math.cos(math.radians(turn)) * math.cos(highest)
    height = math.cos(math.radians(turn)) * math.sin(highest)
    azimuth = (noon + math.degrees(math.atan2(across, along)) + 180) % 360 - 180
    return azimuth, math.degrees(math.asin(height))
