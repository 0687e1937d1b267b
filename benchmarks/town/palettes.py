"""Palettes: colours of every material, the light, the sky. Geometry and labels know nothing of it.

Colours are sRGB in [0, 1] as (r, g, b); intensities of light are linear.
"""

from dataclasses import dataclass, replace

from fprf.errors import DataError

Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Palette:
    """One time of the day and of the year. The defaults are a summer day."""

    name: str = "day"
    azimuth: float = 232.0
    """Degrees from +x towards +y to the sun (or the moon)."""
    elevation: float = 40.0
    """Degrees of the sun above the horizon."""
    sun: Colour = (3.1, 2.8, 2.3)
    """Linear intensity of the sun."""
    ambient: Colour = (0.62, 0.76, 1.0)
    """Linear light from above."""
    bounce: Colour = (0.36, 0.34, 0.29)
    """Linear light from below."""
    exposure: float = 0.62
    zenith: Colour = (0.22, 0.44, 0.80)
    horizon: Colour = (0.74, 0.85, 0.95)
    clouds: Colour = (0.98, 0.98, 0.99)
    cloudiness: float = 0.5
    """Share of the sky that clouds cover."""
    glow: Colour = (0.25, 0.22, 0.15)
    """Added to the sky around the sun."""
    stars: float = 0.0
    haze: Colour = (0.72, 0.82, 0.92)
    haziness: float = 0.35
    """Share of haze in what lies 40 m outside the street."""
    lawn: tuple[Colour, Colour] = ((0.33, 0.43, 0.20), (0.50, 0.57, 0.31))
    litter: Colour = (0.72, 0.38, 0.10)
    """Fallen leaves."""
    littering: float = 0.0
    """Share of the lawn under fallen leaves."""
    snow: Colour = (0.93, 0.95, 0.99)
    snowing: float = 0.0
    """Share of snow, 0 to 1."""
    asphalt: Colour = (0.37, 0.37, 0.39)
    marking: Colour = (0.93, 0.92, 0.88)
    slabs: Colour = (0.66, 0.63, 0.58)
    walls: tuple[Colour, ...] = (
        (0.93, 0.80, 0.55),
        (0.90, 0.62, 0.45),
        (0.95, 0.90, 0.78),
        (0.72, 0.80, 0.84),
        (0.86, 0.52, 0.42),
        (0.80, 0.84, 0.66),
        (0.96, 0.74, 0.38),
        (0.88, 0.76, 0.72),
    )
    bricks: tuple[Colour, ...] = (
        (0.60, 0.35, 0.28),
        (0.66, 0.44, 0.33),
        (0.55, 0.37, 0.32),
        (0.72, 0.56, 0.43),
    )
    stone: Colour = (0.76, 0.70, 0.60)
    timber: Colour = (0.30, 0.20, 0.14)
    trim: Colour = (0.92, 0.90, 0.85)
    shutters: tuple[Colour, ...] = (
        (0.22, 0.40, 0.34),
        (0.25, 0.36, 0.52),
        (0.50, 0.22, 0.18),
        (0.40, 0.30, 0.22),
    )
    doors: tuple[Colour, ...] = (
        (0.45, 0.15, 0.12),
        (0.14, 0.30, 0.26),
        (0.36, 0.24, 0.14),
        (0.16, 0.24, 0.42),
    )
    glass: tuple[Colour, Colour] = ((0.16, 0.21, 0.27), (0.52, 0.62, 0.72))
    """At the foot and at the head of a pane."""
    lit: float = 0.0
    """Share of the windows with light behind."""
    light: Colour = (1.0, 0.72, 0.36)
    """Colour of lit windows and lamps."""
    lamps: float = 0.0
    """Linear intensity of a lamp at one metre."""
    roofs: tuple[Colour, ...] = (
        (0.60, 0.34, 0.25),
        (0.50, 0.30, 0.25),
        (0.66, 0.42, 0.30),
        (0.38, 0.39, 0.43),
    )
    leaves: tuple[tuple[Colour, Colour], ...] = (
        ((0.18, 0.28, 0.13), (0.45, 0.55, 0.26)),
        ((0.21, 0.32, 0.15), (0.54, 0.61, 0.32)),
        ((0.16, 0.26, 0.14), (0.39, 0.49, 0.27)),
        ((0.23, 0.34, 0.17), (0.57, 0.63, 0.36)),
        ((0.18, 0.30, 0.17), (0.43, 0.53, 0.31)),
        ((0.14, 0.25, 0.13), (0.37, 0.47, 0.25)),
        ((0.15, 0.26, 0.13), (0.37, 0.47, 0.23)),
    )
    """Deep and outer leaves of six kinds of trees, then of hedges."""
    bark: Colour = (0.38, 0.30, 0.23)
    iron: Colour = (0.16, 0.18, 0.19)
    paints: tuple[Colour, ...] = (
        (0.72, 0.12, 0.10),
        (0.16, 0.30, 0.55),
        (0.88, 0.88, 0.87),
        (0.18, 0.34, 0.28),
        (0.85, 0.66, 0.18),
        (0.48, 0.50, 0.53),
    )


_DAY = Palette()
_EMBER = (
    ((0.50, 0.18, 0.06), (0.93, 0.48, 0.10)),
    ((0.52, 0.30, 0.06), (0.96, 0.72, 0.18)),
    ((0.45, 0.10, 0.06), (0.85, 0.26, 0.12)),
    ((0.50, 0.34, 0.08), (0.90, 0.64, 0.16)),
    ((0.48, 0.22, 0.06), (0.88, 0.42, 0.12)),
    ((0.40, 0.30, 0.10), (0.74, 0.58, 0.20)),
    ((0.22, 0.26, 0.10), (0.48, 0.46, 0.18)),
)
_FROST = (
    ((0.24, 0.28, 0.24), (0.44, 0.49, 0.44)),
    ((0.28, 0.29, 0.25), (0.48, 0.50, 0.46)),
    ((0.15, 0.23, 0.20), (0.36, 0.45, 0.42)),
    ((0.26, 0.30, 0.27), (0.46, 0.51, 0.48)),
    ((0.18, 0.24, 0.22), (0.42, 0.48, 0.46)),
    ((0.14, 0.22, 0.19), (0.34, 0.43, 0.40)),
    ((0.16, 0.25, 0.18), (0.38, 0.47, 0.38)),
)

PALETTES: dict[str, Palette] = {
    "day": _DAY,
    "autumn": replace(
        _DAY,
        name="autumn",
        azimuth=220.0,
        elevation=28.0,
        sun=(3.3, 2.6, 1.75),
        ambient=(0.70, 0.74, 0.85),
        bounce=(0.42, 0.34, 0.24),
        zenith=(0.42, 0.56, 0.76),
        horizon=(0.92, 0.87, 0.77),
        clouds=(0.97, 0.94, 0.90),
        cloudiness=0.6,
        glow=(0.35, 0.26, 0.12),
        haze=(0.90, 0.82, 0.70),
        haziness=0.5,
        lawn=((0.38, 0.40, 0.14), (0.58, 0.54, 0.24)),
        littering=0.55,
        leaves=_EMBER,
    ),
    "winter": replace(
        _DAY,
        name="winter",
        azimuth=215.0,
        elevation=24.0,
        sun=(1.6, 1.45, 1.25),
        ambient=(0.80, 0.90, 1.08),
        bounce=(0.46, 0.49, 0.55),
        exposure=0.68,
        zenith=(0.62, 0.70, 0.80),
        horizon=(0.86, 0.88, 0.91),
        clouds=(0.92, 0.93, 0.95),
        cloudiness=0.7,
        glow=(0.15, 0.13, 0.10),
        haze=(0.86, 0.89, 0.93),
        haziness=0.65,
        lawn=((0.42, 0.42, 0.30), (0.55, 0.54, 0.42)),
        snowing=1.0,
        asphalt=(0.34, 0.35, 0.38),
        leaves=_FROST,
        lit=0.25,
    ),
    "sunset": replace(
        _DAY,
        name="sunset",
        azimuth=-38.0,
        elevation=13.0,
        sun=(4.2, 2.0, 0.75),
        ambient=(0.50, 0.46, 0.66),
        bounce=(0.34, 0.23, 0.19),
        exposure=0.66,
        zenith=(0.28, 0.33, 0.58),
        horizon=(0.98, 0.62, 0.34),
        clouds=(0.98, 0.60, 0.46),
        cloudiness=0.55,
        glow=(0.50, 0.26, 0.06),
        haze=(0.88, 0.56, 0.42),
        haziness=0.5,
        lit=0.3,
        lamps=2.0,
    ),
    "night": replace(
        _DAY,
        name="night",
        azimuth=235.0,
        elevation=48.0,
        sun=(0.13, 0.17, 0.28),
        ambient=(0.075, 0.10, 0.19),
        bounce=(0.045, 0.045, 0.06),
        exposure=1.0,
        zenith=(0.03, 0.05, 0.13),
        horizon=(0.13, 0.16, 0.28),
        clouds=(0.15, 0.18, 0.28),
        cloudiness=0.35,
        glow=(0.05, 0.06, 0.08),
        stars=0.45,
        haze=(0.09, 0.11, 0.19),
        haziness=0.5,
        lawn=((0.27, 0.33, 0.20), (0.38, 0.43, 0.28)),
        glass=((0.10, 0.12, 0.17), (0.16, 0.20, 0.30)),
        lit=0.65,
        lamps=12.0,
    ),
}
"""By name; the classes and the geometry are the same under each."""

OTHERS: dict[str, Palette] = {
    "overcast": replace(
        _DAY,
        name="overcast",
        sun=(0.0, 0.0, 0.0),
        ambient=(1.5, 1.55, 1.6),
        bounce=(0.6, 0.58, 0.55),
        zenith=(0.80, 0.82, 0.85),
        horizon=(0.88, 0.89, 0.9),
        clouds=(0.9, 0.9, 0.92),
        cloudiness=1.0,
        glow=(0.0, 0.0, 0.0),
    ),
}
"""Those that no mean over palettes counts: a town without a sun, to be lit (`benchmarks.sun`)."""


def palette(name: str) -> Palette:
    """The palette of a name, or DataError."""
    known = {**PALETTES, **OTHERS}
    if name not in known:
        raise DataError(
            f"town palette '{name}': there is none of that name; choose one of {', '.join(known)}"
        )
    return known[name]
