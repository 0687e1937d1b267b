"""A style on a scene of Gaussians: harmonics in, harmonics out.

    colour' = colour A + b,   0.5 + C0 dc' = (0.5 + C0 dc) A + b,   higher harmonics' = harmonics A

so an affine map of colours is exact, from every direction. Stylizers whose config says `colours` carry the colours of each
region over as a whole, and nothing else: content features and a decoder would add nothing, since single Gaussians have
colours that no photograph has. Others move the colours in the place of features. Luminance is kept as an affine map too.
"""

import functools
import math
from typing import Annotated

import torch
from torch import Tensor

from ..fields.planes import harmonics as harmonic_functions
from ..interfaces import Encoder, Stylizer
from ..ops.precision import double
from ..plugins.stylizers.config import StylizerConfig
from ..style.colours import ColourMaps, carried_colours
from ..style.controls import luma, place_weight
from ..style.dictionary import StyleDictionary
from ..style.look import Restyle
from ..style.scene import SceneStyle, membership, own_style
from .gaussians import HARMONIC

__all__ = ["Colours", "as_drawn", "region_maps", "restyled_harmonics"]

_DIRECTIONS = 48
"""In which harmonics are evaluated to find where renderers cut their colours."""
_TINY = 1e-5
"""Colours below this may be rounded to less than 0."""
_ROWS = 1 << 15
"""Gaussians at a time: bounds the memory."""


class Colours(Encoder):
    """Colours as content features."""

    @property
    def identity(self) -> str:
        """They have no weights."""
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
    before: Annotated[Tensor, "N K 3"], means: Annotated[Tensor, "N 3"], semantic: Annotated[Tensor, "N D"], look: Restyle
) -> Annotated[Tensor, "N K 3"]:
    """Harmonics of Gaussians in a look. Those that it leaves alone (strength 0) stay, bit for bit."""
    out = []
    if look.idle:
        return before
    kept = sum(part.share * part.luminance for part in look.parts)
    for start in range(0, len(before), _ROWS):
        rows = before[start : start + _ROWS]
        matrix, bias, weight = _change(look, means[start : start + _ROWS], semantic[start : start + _ROWS])
        matrix = matrix + torch.eye(3)
        if kept > 0:  # what the map adds to luma is taken back from all channels alike
            ones = torch.ones(1, 3)
            matrix = matrix + kept * (luma(torch.eye(3)) - luma(matrix)) * ones
            bias = bias - kept * luma(bias) * ones
        drawn = as_drawn(rows)
        colour = 0.5 + HARMONIC * drawn[:, 0]
        moved = torch.einsum("nc,ncd->nd", colour, matrix) + bias
        # Within the range of colours, but for those that were outside: what is brighter than white would glow at soft edges.
        moved = moved.maximum(colour.clamp_max(0)).minimum(colour.clamp_min(1))
        new = torch.einsum("nkc,ncd->nkd", drawn, matrix)
        new[:, 0] = (moved - 0.5) / HARMONIC
        out.append(torch.where((weight > 0)[:, None, None], new, rows))
    return torch.cat(out)


def as_drawn(harmonics: Annotated[Tensor, "N K 3"]) -> Annotated[Tensor, "N K 3"]:
    """Harmonics of the colours that renderers show, which are cut at 0: a map would lift what was hidden below.

    Where some direction is cut, the cut colours of directions all around are fitted again, in least squares, by the harmonics
    up to degree 3.
    """
    count = min(harmonics.shape[1], 16)
    bands = math.isqrt(count)
    # In no direction harmonics of degree l are further from 0 than their norm times sqrt((2 l + 1) / 4 pi) (addition theorem).
    square = harmonics[:, :count].square()
    low = 0.5 + HARMONIC * harmonics[:, 0]
    for k in range(1, bands):
        # Sums of slices: vectorised over rows, as reductions of a few numbers are not.
        norm = functools.reduce(torch.add, square[:, k * k : (k + 1) ** 2].unbind(1)).sqrt()
        low -= math.sqrt((2 * k + 1) / (4 * math.pi)) * norm
    some = (low.amin(1) < _TINY).nonzero()[:, 0]
    at = torch.arange(_DIRECTIONS) + 0.5
    height, turn = 1 - 2 * at / _DIRECTIONS, at * (math.pi * (5**0.5 - 1))
    flat = (1 - height.square()).sqrt()
    around = torch.stack([flat * turn.cos(), flat * turn.sin(), height], 1)
    basis = harmonic_functions(around, bands)
    colour = 0.5 + torch.einsum("db,nbc->ndc", basis, harmonics[some, :count])
    dark = colour.amin((1, 2)) < 0
    out = harmonics.clone()
    fitted = torch.einsum("bd,ndc->nbc", torch.linalg.pinv(basis), colour[dark].clamp_min(0) - 0.5)
    out[some[dark], :count] = fitted
    return out


def _change(
    look: Restyle, means: Annotated[Tensor, "N 3"], semantic: Annotated[Tensor, "N D"]
) -> tuple[Annotated[Tensor, "N 3 3"], Annotated[Tensor, "N 3"], Annotated[Tensor, "N"]]:
    """The change of a look against the identity: A and b of each Gaussian, c' = c + c A + b, and its strength."""
    matrix, bias, weight = semantic.new_zeros(len(semantic), 3, 3), semantic.new_zeros(len(semantic), 3), semantic.new_zeros(())
    for part in look.parts:
        if part.share == 0 or part.strength == 0:
            continue
        acts = (
            part.share
            * part.strength
            * (semantic.new_ones(len(semantic), 1) if part.regions is None else part.regions(semantic))
        )
        added = _added(part, semantic)
        for place, other in part.places:
            inside = place_weight(place, means)[:, None]
            if bool(inside.any()):
                there = _added(other, semantic)
                added = torch.lerp(added[0], there[0], inside[..., None]), torch.lerp(added[1], there[1], inside)
        matrix, bias, weight = matrix + acts[..., None] * added[0], bias + acts * added[1], weight + acts[:, 0]
    return matrix, bias, weight


def _added(part: Restyle, semantic: Annotated[Tensor, "N D"]) -> tuple[Annotated[Tensor, "N 3 3"], Annotated[Tensor, "N 3"]]:
    """A and b of one part at full strength."""
    if part.colours is not None:
        maps = part.colours
        belongs = membership(semantic, maps.semantic_mean, maps.units, maps.softness)
        return torch.einsum("nk,kcd->ncd", belongs, maps.matrix), belongs @ maps.bias
    # An affine stylizer is known by what it makes of black and of each channel alone.
    black = part.stylizer(semantic.new_zeros(len(semantic), 3), semantic)
    rows = [part.stylizer(axis.expand(len(semantic), 3), semantic) - black for axis in torch.eye(3)]
    return part.features * (torch.stack(rows, 1) - torch.eye(3)), part.features * black


def region_maps(
    stylizer: Stylizer, dictionary: StyleDictionary, style: SceneStyle, config: StylizerConfig
) -> ColourMaps | None:
    """Carry the colours of each region over to those of the codes that it takes; None where the config asks for none."""
    if config.colours <= 0:
        return None
    # Matched with itself as with the photographs, the scene keeps its colours.
    mine = own_style(style, dictionary.blend)._replace(origin=dictionary.origin)
    table = double(config.build(dictionary=mine, scene=style).match(style.keys))
    mean, covariances = table @ double(mine.mean), torch.einsum("kt,tij->kij", table, double(mine.covariance))
    taken = double(stylizer.match(style.keys))
    return ColourMaps(style, *carried_colours(mean, covariances, taken, dictionary), config.colours)
