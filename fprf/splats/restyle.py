"""A style on a scene of Gaussians: harmonics in, harmonics out.

An affine map of colours is exact on harmonics, from every direction (`ops.harmonics`). Stylizers whose config
says `colours` carry the colours of each region over as a whole, and nothing else: content features and a
decoder would add nothing, since single Gaussians have colours that no photograph has. Others move the colours
in the place of features. Luminance is kept as an affine map too.
"""

import math
from functools import cache
from typing import Annotated

import torch
from torch import Tensor

from ..interfaces import Encoder
from ..ops.harmonics import Directions, recoloured, spherical_harmonics
from ..style.light import luma
from ..style.look import Restyle, place_weight

_CUT_DIRECTIONS = 48
"""Directions in which harmonics are evaluated to find where renderers cut their colours; by eye."""
_RECOLOURED_GAUSSIANS = 1 << 15
"""Gaussians at a time: bounds the memory."""


class ColourEncoder(Encoder):
    """Colours as content features."""

    @property
    def identity(self) -> str:
        """A constant: there are no weights."""
        return "colours"

    @property
    def channels(self) -> int:
        """Red, green and blue."""
        return 3

    def forward(self, image: Annotated[Tensor, "B 3 H W"]) -> Annotated[Tensor, "B 3 H W"]:
        """The image itself."""
        return image


@torch.inference_mode()
def restyled_harmonics(
    before: Annotated[Tensor, "N K 3"],
    means: Annotated[Tensor, "N 3"],
    semantic: Annotated[Tensor, "N D"],
    look: Restyle,
    seen_at: Annotated[Tensor, "N 3"] | None = None,
) -> Annotated[Tensor, "N K 3"]:
    """Harmonics of Gaussians in a look. Those that it leaves alone (strength 0) stay, bit for bit.

    `seen_at` is where the views of the scene show them; None = at their means.
    """
    if look.painted_nothing:
        return before
    out = torch.empty_like(before)
    kept = sum(part.share * part.luminance for part in look.parts)
    directions = all_around(before.shape[1])
    for start in range(0, len(before), _RECOLOURED_GAUSSIANS):
        rows = slice(start, start + _RECOLOURED_GAUSSIANS)
        # The change against the identity, A and below it b of each Gaussian (c' = c + c A + b), and how
        # strongly the look acts.
        features = semantic[rows].to(means)
        points = means[rows] if seen_at is None else seen_at[rows]
        change = features.new_zeros(len(features), 4, 3)
        weight = features.new_zeros(len(features))
        for part in look.parts:
            if part.share == 0 or part.strength == 0:
                continue
            if part.regions is None:
                regions = features.new_ones(len(features), 1)
            else:
                regions = part.regions(features)
            acts = part.share * part.strength * regions
            added = _added(part, features, points)
            for place, other in part.places:  # a later place lies over those before it
                inside = place_weight(place, means[rows])[:, None]
                if bool(inside.any()):
                    added = torch.lerp(added, _added(other, features, points), inside[..., None])
            change = change + acts[..., None] * added
            weight = weight + acts[:, 0]
        if kept > 0:  # what the map adds to luma is taken back from all channels alike
            change = change - kept * luma(change)
        out[rows] = recoloured(before[rows], change, weight, directions)
    return out


@cache
def all_around(bands: int) -> Directions:
    """Directions all around, for that many bands; no more than those of degree 3."""
    at = torch.arange(_CUT_DIRECTIONS) + 0.5
    height = 1 - 2 * at / _CUT_DIRECTIONS
    turn = at * (math.pi * (5**0.5 - 1))
    flat = (1 - height.square()).sqrt()
    around = torch.stack([flat * turn.cos(), flat * turn.sin(), height], 1)
    values = spherical_harmonics(around, math.isqrt(min(bands, 16)))
    return Directions(values.T.contiguous(), torch.linalg.pinv(values))


def _added(
    part: Restyle, semantic: Annotated[Tensor, "N D"], points: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N 4 3"]:
    """A and b of one part at full strength: what its stylizer and colours paint, and the light that falls on
    it.
    """
    # Light and paint are of one scene, and so are the regions that they ask about.
    belongs = None
    if part.light is not None:
        belongs = part.light.membership(semantic)
    matched = _matched(part, semantic, belongs)
    if part.placed is None:
        return matched
    measured = part.placed(semantic, belongs, points)
    both: Tensor = (1 - measured.share[..., None]) * matched + measured.maps
    return both


def _matched(
    part: Restyle, semantic: Annotated[Tensor, "N D"], belongs: Annotated[Tensor, "N K"] | None
) -> Annotated[Tensor, "N 4 3"]:
    """A and b of what is matched. `belongs` is the membership, where it is known."""
    if part.colours is not None:
        maps = part.colours
        share: Tensor = maps.membership(semantic) if belongs is None else belongs
        painted = (share @ torch.cat([maps.matrix, maps.bias[:, None]], 1).flatten(1)).view(-1, 4, 3)
    else:
        # An affine stylizer is known by what it makes of black and of each channel alone.
        black = part.stylizer(semantic.new_zeros(len(semantic), 3), semantic)
        rows = []
        for axis in torch.eye(3):
            rows.append(part.stylizer(axis.expand(len(semantic), 3), semantic) - black - axis)
        painted = part.features * torch.stack([*rows, black], 1)
    if part.light is None:
        return painted
    paint = part.light.paint(semantic, belongs)
    return paint[..., None] * painted + part.light.change(semantic, paint, belongs)
