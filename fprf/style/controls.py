"""Controls of a style as mathematics: strength, regions, references, and luminance.

Strengths are one number or one a point. Luminance is Rec. 709 luma of sRGB. It is kept on the colour of each point, not of
each pixel: luma is linear, so both would agree but for what leaves the range of colours, and on points that is mended where
it happens: every point's colour stays in [0, 1] (which is what bounds the renderer's error) and is the same from every view.
"""

from collections.abc import Mapping, Sequence, Set
from typing import Annotated

import torch
from torch import Tensor

from ..errors import UsageError
from .config import Place

_LUMA = (0.2126, 0.7152, 0.0722)
"""Rec. 709."""


def blend_strength(
    content: Annotated[Tensor, "N C"], styled: Annotated[Tensor, "N C"], strength: float | Annotated[Tensor, "N 1"]
) -> Annotated[Tensor, "N C"]:
    """Between the scene's features (strength 0, bit for bit) and the styled ones (strength 1, bit for bit), all finite.

    Raises UsageError for one strength outside [0, 1].
    """
    if isinstance(strength, Tensor):
        return torch.lerp(content, styled, strength.to(content))
    if not 0.0 <= strength <= 1.0:
        raise UsageError(f"strength: {strength} must lie in [0, 1]")
    if strength == 0.0:
        return content
    if strength == 1.0:
        return styled
    return torch.lerp(content, styled, strength)


def luma(rgb: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 1"]:
    """Luma of sRGB colours, in [0, 1] for colours in [0, 1]."""
    return (rgb * rgb.new_tensor(_LUMA)).sum(-1, keepdim=True)


def keep_luminance(
    styled: Annotated[Tensor, "N 3"], own: Annotated[Tensor, "N 3"], share: float | Annotated[Tensor, "N 1"]
) -> Annotated[Tensor, "N 3"]:
    """Styled colours whose luma is moved towards the scene's own by `share`: 0 changes nothing, 1 gives luma(own).

    All in [0, 1]. A colour that would leave that range fades towards grey just as far as it must, which leaves its luma.
    """
    before = luma(styled)
    shift = share * (luma(own) - before)
    moved, level = styled + shift, before + shift
    tint = moved - level
    room = torch.where(tint > 0, 1 - level, level)
    fits = (room / tint.abs().clamp_min(torch.finfo(tint.dtype).tiny)).amin(-1, keepdim=True)
    leaves = ((moved < 0) | (moved > 1)).any(-1, keepdim=True)
    return torch.where(leaves, level + fits * tint, moved).clamp(0, 1)  # rounding alone leaves the range now


def place_weight(place: Place, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
    """1 inside of a place, 0 beyond its border, and falling smoothly with the distance between."""
    corners = points.new_tensor(place.points)
    if place.width is None:
        away = torch.maximum(corners[0] - points, points - corners[1]).clamp_min(0).norm(dim=1)
    else:
        first, along = corners[:-1], corners[1:] - corners[:-1]
        local = points[:, None] - first
        share = (local * along).sum(2) / along.square().sum(1).clamp_min(torch.finfo(points.dtype).tiny)
        nearest = local - share.clamp(0, 1)[..., None] * along
        away = (nearest.norm(dim=2).amin(1) - place.width / 2).clamp_min(0)
    if place.border == 0:
        sharp: Tensor = (away == 0).to(points)
        return sharp
    inside = (1 - away / place.border).clamp(0, 1)
    smooth: Tensor = inside.square() * (3 - 2 * inside)
    return smooth


def allowed_references(
    regions: int,
    references: int,
    *,
    pin: Mapping[int, Set[int]] | None = None,
    forbid: Sequence[tuple[int, int]] = (),
) -> Annotated[Tensor, "regions references"]:
    """References that each region may take codes from, bool: all, but for what the user excludes.

    `pin` maps a region to the only references that it may take from; `forbid` holds (region, reference) pairs that may not
    meet. Raises UsageError for numbers out of range or a region that is left with nothing.
    """
    pin = pin or {}
    for k, i in (*((k, i) for k, chosen in pin.items() for i in sorted(chosen)), *forbid):
        if not (0 <= k < regions and 0 <= i < references):
            raise UsageError(
                f"region {k} and reference {i}: regions go from 0 to {regions - 1}, references from 0 to {references - 1}"
            )
    allowed = torch.ones(regions, references, dtype=torch.bool)
    for k, chosen in pin.items():
        allowed[k] = False
        allowed[k, sorted(chosen)] = True
    for k, i in forbid:
        allowed[k, i] = False
    for k in (~allowed.any(1)).nonzero().flatten().tolist():
        raise UsageError(f"region {k}: every reference is forbidden; allow one, or keep the region as it is")
    return allowed
