"""CIEDE2000: how different two colours look. About 1 is just visible, 10 is another shade, 50 another colour.

After Sharma, Wu and Dalal 2005, with k_L = k_C = k_H = 1; float64 throughout. Lab is that of the illuminant D65, with a
lightness from 0 to 100; sRGB is in [0, 1].
"""

import math
from typing import Annotated

import torch
from torch import Tensor

from ..io.images import srgb_to_linear

__all__ = ["delta_e", "delta_e_2000", "srgb_to_lab"]

_TO_XYZ = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)
"""Linear sRGB to CIE XYZ (IEC 61966-2-1)."""
_POLE = 25.0**7
_EDGE = 6 / 29
"""Where Lab's cube root turns into a line."""


def delta_e(a: Annotated[Tensor, "... 3"], b: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "..."]:
    """Difference of sRGB colours in [0, 1], at least 0; symmetric."""
    return delta_e_2000(srgb_to_lab(a), srgb_to_lab(b))


def srgb_to_lab(rgb: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "... 3"]:
    """CIE Lab of sRGB colours in [0, 1]; white is the sum of the primaries, so greys have no hue."""
    matrix = torch.tensor(_TO_XYZ, dtype=torch.float64, device=rgb.device)
    xyz = srgb_to_linear(rgb.double()) @ matrix.T / matrix.sum(1)
    root = torch.where(xyz > _EDGE**3, xyz.clamp_min(1e-12) ** (1 / 3), xyz / (3 * _EDGE**2) + 4 / 29)
    x, y, z = root.unbind(-1)
    return torch.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def delta_e_2000(first: Annotated[Tensor, "... 3"], second: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "..."]:
    """Difference of Lab colours."""
    light1, a1, b1 = first.double().unbind(-1)
    light2, a2, b2 = second.double().unbind(-1)
    chroma = (torch.hypot(a1, b1) + torch.hypot(a2, b2)) / 2
    stretch = 1.5 - 0.5 * _dulled(chroma)
    a1, a2 = a1 * stretch, a2 * stretch
    c1, c2 = torch.hypot(a1, b1), torch.hypot(a2, b2)
    h1, h2 = torch.atan2(b1, a1) % (2 * math.pi), torch.atan2(b2, a2) % (2 * math.pi)
    coloured = (c1 * c2) > 0
    apart = h2 - h1
    turn = torch.where(apart > math.pi, apart - 2 * math.pi, torch.where(apart < -math.pi, apart + 2 * math.pi, apart))
    turn = torch.where(coloured, turn, 0.0)
    d_light, d_chroma = light2 - light1, c2 - c1
    d_hue = 2 * (c1 * c2).sqrt() * torch.sin(turn / 2)

    light, c = (light1 + light2) / 2, (c1 + c2) / 2
    middle = torch.where(apart.abs() > math.pi, (h1 + h2 + 2 * math.pi) / 2 % (2 * math.pi), (h1 + h2) / 2)
    hue = torch.where(coloured, middle, h1 + h2)
    weight = (
        1
        - 0.17 * torch.cos(hue - math.radians(30))
        + 0.24 * torch.cos(2 * hue)
        + 0.32 * torch.cos(3 * hue + math.radians(6))
        - 0.20 * torch.cos(4 * hue - math.radians(63))
    )
    s_light = 1 + 0.015 * (light - 50) ** 2 / (20 + (light - 50) ** 2).sqrt()
    s_chroma, s_hue = 1 + 0.045 * c, 1 + 0.015 * c * weight
    blue = math.radians(30) * torch.exp(-(((torch.rad2deg(hue) - 275) / 25) ** 2))
    twist = -torch.sin(2 * blue) * 2 * _dulled(c)
    l, k, h = d_light / s_light, d_chroma / s_chroma, d_hue / s_hue
    return (l * l + k * k + h * h + twist * k * h).clamp_min(0).sqrt()


def _dulled(chroma: Tensor) -> Tensor:
    power = chroma**7
    return (power / (power + _POLE)).sqrt()
