"""Colours of Gaussians in another light.

Linear light. On a surface with the normal n, of whose sky the share O is open and which the share T of the sun's
light reaches, falls

    E = sun T max(0, n l) + O (sky u + bounce (1 - u)),    u = (1 + n up) / 2,    bounce = albedo (sky + sun l up)

and a colour is multiplied by e (E / E0), with E0 the captured light (clouds: sky white, no sun) and e the factor
that keeps the mean brightness of what is lit. sRGB + 0.055 is a power of linear light (IEC 61966-2-1), so that
the map of a colour is affine, and exact on harmonics:

    c' = k (c + 0.055) - 0.055,    k = (e E / E0)^(1 / 2.4).
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from .sky import Light

LINEAR_OFFSET = 0.055
"""Added to sRGB, it is a power of linear light."""
_POWER = 1 / 2.4
"""Of linear light, which gives sRGB + 0.055 but for a factor."""
_GROUND_ALBEDO = 0.25
"""Share of light that the ground sends back (grass 0.25, asphalt 0.12, concrete 0.4)."""
_MIN_OPENNESS = 0.15
"""Share of the sky's light that the darkest corner has: light bounces (by eye)."""
_MAX_GAIN = 2.2
"""Of c + 0.055: more would show what the capture has of noise in its shade (by eye)."""
_MIN_RATIO = 1e-3
"""Of lights, so that powers are finite."""
_LUMA = (0.2126, 0.7152, 0.0722)
"""Shares of linear red, green and blue in brightness (IEC 61966-2-1)."""


class Received(NamedTuple):
    """What N Gaussians receive."""

    normals: Annotated[Tensor, "N 3"]
    sure: Annotated[Tensor, "N"]
    """Of the normals, in [0, 1]: where they are not, light comes from around."""
    openness: Annotated[Tensor, "N"]
    """Share of the sky that is open, in [0, 1]."""
    reach: Annotated[Tensor, "N"]
    """Share of the sun's light that arrives, in [0, 1]."""


def irradiance(
    received: Received, light: Light, sun: Annotated[Tensor, "3"], up: Annotated[Tensor, "3"]
) -> tuple[Annotated[Tensor, "N 3"], Annotated[Tensor, "N"]]:
    """Light on surfaces, and the share of the sun's that meets them; `sun` and `up` are unit vectors."""
    level = (received.normals @ up + 1) / 2
    facing = received.normals @ sun
    # Of a volume, such as a crown, some side always faces the sun.
    around = (facing + 1).square() / 4
    meets = received.reach * torch.lerp(around, facing.clamp_min(0), received.sure)
    bounce = _GROUND_ALBEDO * (light.sky + light.sun * (sun @ up).clamp_min(0))
    sky = level[:, None] * light.sky + (1 - level)[:, None] * bounce
    opened = received.openness.clamp_min(_MIN_OPENNESS)[:, None]
    return meets[:, None] * light.sun + opened * sky, meets


def captured_irradiance(received: Received, up: Annotated[Tensor, "3"]) -> Annotated[Tensor, "N 3"]:
    """The captured light, taken to be that of clouds or shade."""
    level = ((received.normals @ up + 1) / 2)[:, None]
    return received.openness.clamp_min(_MIN_OPENNESS)[:, None] * (
        level + (1 - level) * _GROUND_ALBEDO
    ).expand(-1, 3)


def gains(
    received: Received,
    light: Light,
    sun: Annotated[Tensor, "3"],
    up: Annotated[Tensor, "3"],
    colours: Annotated[Tensor, "N 3"],
    weights: Annotated[Tensor, "N"],
) -> Annotated[Tensor, "N 3"]:
    """k of each Gaussian, at a brightness that keeps the mean luma of what is lit; `weights` say how much of
    each is seen.
    """
    new, meets = irradiance(received, light, sun, up)
    ratio = new / captured_irradiance(received, up)
    luma = torch.tensor(_LUMA)
    linear = (colours.clamp(0, 1) + LINEAR_OFFSET).pow(1 / _POWER)
    lit = weights * (meets if bool(light.sun.any()) else torch.ones_like(weights))
    before = float((lit * (linear @ luma)).sum())
    after = float((lit * ((linear * ratio) @ luma)).sum())
    exposure = light.brightness * before / after if after > 0 else 1.0
    return (exposure * ratio).clamp_min(_MIN_RATIO).pow(_POWER).clamp_max(_MAX_GAIN)


def affine_change(gain: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 4 3"]:
    """A - 1 and below it b of c' = k (c + 0.055) - 0.055."""
    added = gain - 1
    return torch.cat([torch.diag_embed(added), LINEAR_OFFSET * added[:, None]], 1)
