"""Colours of Gaussians in another light.

Linear light. On a surface with the normal n, to which the share O of the sky's light comes and the share T of the
sun's, falls

    E = sun T max(0, n l) + O^(3/4) (sky u + bounce (1 - u)),    u = (1 + n up) / 2,    bounce = albedo (sky + sun l up)

The power stands for light that comes to corners from what is lit around them. The captured light E0 is taken to be
that of clouds: a white sky, no sun. Cameras compress what is bright, and so does what is drawn here: with y the
linear sRGB of a Gaussian's mean colour and a shoulder s,

    x = y / (1 - s y),    x' = e (E / E0) x,    y' = x' / (1 + s x'),

e being the factor that keeps the mean brightness of all but the sky, as a camera meters it. The map of a
Gaussian's colours from every direction is the one that takes its mean colour there: affine, and so exact on
harmonics,

    c' = k (c + 0.055) - 0.055,    k = (c'_mean + 0.055) / (c_mean + 0.055).
"""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..io.images import srgb_to_linear
from .sky import LUMA, Light

LINEAR_OFFSET = 0.055
"""Added to sRGB, it is a power of linear light."""
SHOULDER = 0.7
"""s above. On the town 0.6 and 0.85 are 0.2 to 0.6 dB better than none, and alike."""
GROUND_ALBEDO = 0.2
"""Share of light that the ground sends back (grass 0.25, asphalt 0.12, concrete 0.4); on the town 0.15 is better
than 0.4 by 0.1 to 0.6 dB.
"""
_MIN_OPENNESS = 0.02
"""Of what lies in the darkest corner, so that ratios are finite."""
_OPENNESS_POWER = 0.75
"""3/4 above. Scenes with light that bounces (`sun_traced.json`) gain 0.14 dB from 1/2 to 1, the town, whose tracer
knows corners of the ground alone, loses 0.03 dB.
"""
MAX_GAIN = 2.5
"""Of c + 0.055: more would show what the capture has of noise in its shade (by eye)."""
_METERED_GAUSSIANS = 8192
"""Gaussians that brightness is measured on, about."""
_METER_STEPS = 20
"""Halvings of the range of exposures, 2^-8 to 2^8: to 2^-16."""


class Received(NamedTuple):
    """Light that N Gaussians receive."""

    normals: Annotated[Tensor, "N 3"]
    sure: Annotated[Tensor, "N"]
    """Of the normals, in [0, 1]: where they are not, light comes from around."""
    openness: Annotated[Tensor, "N"]
    """Share of the sky that is open, in [0, 1]."""
    reach: Annotated[Tensor, "N"]
    """Share of the sun's light that arrives, in [0, 1]."""


def irradiance(
    received: Received, light: Light, sun: Annotated[Tensor, "3"], up: Annotated[Tensor, "3"]
) -> Annotated[Tensor, "N 3"]:
    """Light on surfaces; `sun` and `up` are unit vectors."""
    level = level_share(received, up)
    meets = sun_share(received, sun)
    sky = level[:, None] * light.sky + (1 - level)[:, None] * bounced(light, sun, up)
    return meets[:, None] * light.sun + sky_share(received)[:, None] * sky


def captured_irradiance(received: Received, up: Annotated[Tensor, "3"]) -> Annotated[Tensor, "N 3"]:
    """The captured light, taken to be that of clouds or shade."""
    level = level_share(received, up)[:, None]
    return sky_share(received)[:, None] * (level + (1 - level) * GROUND_ALBEDO).expand(-1, 3)


def level_share(received: Received, up: Annotated[Tensor, "3"]) -> Annotated[Tensor, "N"]:
    """u above: how far surfaces face the sky, in [0, 1]; the rest faces the ground."""
    return (received.normals @ up + 1) / 2


def sky_share(received: Received) -> Annotated[Tensor, "N"]:
    """O^(3/4) above, in [0.05, 1]."""
    return received.openness.clamp_min(_MIN_OPENNESS).pow(_OPENNESS_POWER)


def sun_share(received: Received, sun: Annotated[Tensor, "3"]) -> Annotated[Tensor, "N"]:
    """T max(0, n l) above, in [0, 1]: of a volume, such as a crown, some side always faces the sun."""
    facing = received.normals @ sun
    around = (facing + 1).square() / 4
    return received.reach * torch.lerp(around, facing.clamp_min(0), received.sure)


def bounced(light: Light, sun: Annotated[Tensor, "3"], up: Annotated[Tensor, "3"]) -> Annotated[Tensor, "3"]:
    """Light that the ground sends back."""
    return GROUND_ALBEDO * (light.sky + light.sun * (sun @ up).clamp_min(0))


def gains(
    received: Received,
    light: Light,
    sun: Annotated[Tensor, "3"],
    up: Annotated[Tensor, "3"],
    colours: Annotated[Tensor, "N 3"],
    weights: Annotated[Tensor, "N"],
) -> Annotated[Tensor, "N 3"]:
    """k of each Gaussian, at a brightness that keeps the mean luma; `weights` say how much of each is seen."""
    return exposed_gain(light_ratio(received, light, sun, up), colours, weights, light.brightness)


def light_ratio(
    received: Received, light: Light, sun: Annotated[Tensor, "3"], up: Annotated[Tensor, "3"]
) -> Annotated[Tensor, "N 3"]:
    """E / E0 above."""
    return irradiance(received, light, sun, up) / captured_irradiance(received, up)


def exposed_gain(
    ratio: Annotated[Tensor, "N 3"],
    colours: Annotated[Tensor, "N 3"],
    weights: Annotated[Tensor, "N"],
    share: float,
) -> Annotated[Tensor, "N 3"]:
    """k of each Gaussian for E / E0 above; the mean luma becomes `share` of what it was."""
    before = srgb_to_linear(colours.clamp(0, 1))
    exposure = _exposure(before, ratio, weights, share)
    after = encoded(_compressed(before, exposure * ratio))
    gain = (after + LINEAR_OFFSET) / (encoded(before) + LINEAR_OFFSET)
    return gain.clamp_max(MAX_GAIN)


def exposure_of(
    received: Received,
    light: Light,
    sun: Annotated[Tensor, "3"],
    up: Annotated[Tensor, "3"],
    colours: Annotated[Tensor, "N 3"],
    weights: Annotated[Tensor, "N"],
) -> float:
    """e of `gains`, above."""
    return _exposure(
        srgb_to_linear(colours.clamp(0, 1)), light_ratio(received, light, sun, up), weights, light.brightness
    )


def encoded(light: Tensor) -> Tensor:
    """sRGB of linear light."""
    curve = (1 + LINEAR_OFFSET) * light.clamp_min(0.0031308).pow(1 / 2.4) - LINEAR_OFFSET
    return torch.where(light <= 0.0031308, 12.92 * light, curve)


def _compressed(light: Tensor, factor: Tensor) -> Tensor:
    """Linear light of which the scene has `factor` times as much, behind a camera's shoulder."""
    scene = factor * light / (1 - SHOULDER * light)
    return scene / (1 + SHOULDER * scene)


def _exposure(
    before: Annotated[Tensor, "N 3"],
    ratio: Annotated[Tensor, "N 3"],
    weights: Annotated[Tensor, "N"],
    share: float,
) -> float:
    """The factor at which the weighted mean luma is `share` of what it was."""
    some = slice(None, None, max(1, len(before) // _METERED_GAUSSIANS))
    before = before[some]
    ratio = ratio[some]
    weight = weights[some, None] * torch.tensor(LUMA)
    wanted = share * float((before * weight).sum())
    if wanted == 0:  # nothing is lit
        return share
    low = -8.0
    high = 8.0
    for _ in range(_METER_STEPS):
        middle = (low + high) / 2
        if float((_compressed(before, 2**middle * ratio) * weight).sum()) > wanted:
            high = middle
        else:
            low = middle
    return float(2 ** ((low + high) / 2))


def affine_change(gain: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 4 3"]:
    """A - 1 and below it b of c' = k (c + 0.055) - 0.055."""
    added = gain - 1
    return torch.cat([torch.diag_embed(added), LINEAR_OFFSET * added[:, None]], 1)
