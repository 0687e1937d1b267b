"""Colour transfer between pictures, each on its own: what anybody can do without a scene. The baselines of restyling.

Colours [N 3] are sRGB in [0, 1]. `style` is any set of pixels, of one reference or of several together.
"""

from typing import Annotated

import torch
from kornia.color import lab_to_rgb, rgb_to_lab
from torch import Tensor

from ..errors import DataError

__all__ = ["histogram_matching", "reinhard"]

_STILL = 1e-3
"""Units of Lab (whose lightness goes to 100): a channel that deviates less has no contrast to scale."""


def reinhard(content: Annotated[Tensor, "N 3"], style: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "N 3"]:
    """Mean and deviation of every channel of CIE Lab from the style (Reinhard et al. 2001); clipped to the gamut.

    Raises DataError where a side has no pixel.
    """
    _filled(content, style)
    here, there = _lab(content), _lab(style)
    deviation = here.std(0, correction=0)
    gain = torch.where(deviation > _STILL, there.std(0, correction=0) / deviation.clamp_min(_STILL), 1.0)
    moved = (here - here.mean(0)) * gain + there.mean(0)
    # A colour beyond the gamut is clipped; so are the intermediate values of Lab's cubes, which must not be negative.
    return lab_to_rgb(moved.T.reshape(1, 3, -1, 1), clip=True)[0, :, :, 0].T.clamp(0, 1)


def histogram_matching(content: Annotated[Tensor, "N 3"], style: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "N 3"]:
    """Each channel of sRGB gets the style's distribution: a colour goes to the one of the same rank.

    Equal values stay equal (they take the middle of their ranks). Raises DataError where a side has no pixel.
    """
    _filled(content, style)
    columns = []
    for here, there in zip(content.double().T, style.double().T, strict=True):
        _, which, count = torch.unique(here, return_inverse=True, return_counts=True)
        rank = (count.cumsum(0) - 0.5 * count).double() / len(here)
        at = rank * len(there) - 0.5
        low = at.floor().clamp(0, len(there) - 1)
        ordered = there.sort().values
        high = ordered[(low + 1).clamp_max(len(there) - 1).long()]
        columns.append(torch.lerp(ordered[low.long()], high, (at - low).clamp(0, 1))[which])
    return torch.stack(columns, 1).to(content)


def _filled(content: Tensor, style: Tensor) -> None:
    if len(content) == 0 or len(style) == 0:
        raise DataError(f"colour transfer: {len(content)} pixels and {len(style)} of the style; both need at least one")


def _lab(colours: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    lab: Tensor = rgb_to_lab(colours.T.reshape(1, 3, -1, 1))[0, :, :, 0].T
    return lab
