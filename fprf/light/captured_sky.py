"""The sky of a capture, and its colours in another light. Linear sRGB; S Gaussians of the sky."""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from .relight import LINEAR_OFFSET
from .sky import LUMA, Light, horizon_tint

MIN_SKY_COLOUR = 0.02
"""Linear light that a captured sky has at least."""
MIN_BLUENESS = 0.2
"""Logarithm of blue over red of a captured sky that counts as blue, at least (by eye)."""
MAX_SKY_GAIN = 4.0
"""Of a sky's linear light (by eye)."""
MAX_HUE_GAIN = 20.0
"""Of a channel of a blue sky that turns grey: its red is so much darker (by eye)."""
_CLEAR_SKY_SHARE = 0.75
"""Brightness of a clear sky over that of clouds, in pictures (by eye)."""


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

    def gain(
        self, colours: Annotated[Tensor, "S 3"], heights: Annotated[Tensor, "S"], light: Light
    ) -> Annotated[Tensor, "S 3"]:
        """Factors of colours + 0.055 that give the captured sky, in the mean at each height, the light's own colours.

        Where the captured sky is bluer than these, clouds and what is between them take one hue: of both only the
        brightness stays. Else clouds would turn as much more orange as the blue turns grey.
        """
        height = heights.clamp(0, 1)[:, None]
        mean = self.mean_at(height)
        horizon, zenith = self.colours_in(light)
        wanted = torch.lerp(horizon, zenith, height.sqrt())
        own = _linear(colours)
        luma = torch.tensor(LUMA)
        brighter = ((own @ luma) / (mean @ luma))[:, None]
        one_hue = (wanted * brighter / own.clamp_min(MIN_SKY_COLOUR)).clamp_max(MAX_HUE_GAIN)
        blue = blueness(mean)
        share = ((blue - blueness(wanted)) / blue.clamp_min(MIN_BLUENESS)).clamp(0, 1)[:, None]
        kept = (wanted / mean).clamp_max(MAX_SKY_GAIN)
        gain: Tensor = torch.exp(torch.lerp(kept.log(), one_hue.log(), share) / 2.4)
        return gain

    def level(self, light: Light) -> float:
        """Brightness in another light: the sky stays as bright as it is, but for what the light asks."""
        level = light.brightness * self.brightness
        if bool(light.sun.any()):
            level *= _CLEAR_SKY_SHARE
        return level


def blueness(colour: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "..."]:
    """Logarithm of blue over red of linear light."""
    return (colour[..., 2] / colour[..., 0]).log()


def fitted_sky(
    colours: Annotated[Tensor, "S 3"], heights: Annotated[Tensor, "S"], weights: Annotated[Tensor, "S"]
) -> CapturedSky:
    """The sky of Gaussians of sRGB colours, at sines of heights, which weigh so many pixels in views."""
    height = heights.clamp(0, 1)
    weight = (weights + 1e-6)[:, None]
    rows = torch.stack([torch.ones_like(height), height], 1)
    scaled = (rows * weight.sqrt()).double()
    fit = torch.linalg.lstsq(scaled, (_linear(colours) * weight.sqrt()).double()).solution
    found = CapturedSky(fit.float(), 0.0)
    mean = found.mean_at(height[:, None])
    return found._replace(brightness=float((mean * weight).sum() / (3 * weight.sum())))


def _linear(colours: Annotated[Tensor, "S 3"]) -> Annotated[Tensor, "S 3"]:
    """Linear light of sRGB, about."""
    return (colours.clamp(0, 1) + LINEAR_OFFSET).pow(2.4)
