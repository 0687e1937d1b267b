"""The light of captures: gains that take one to the light of others beside it, or of photographs."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import UsageError
from ..style.dictionary import code_odds
from ..style.look import ColourMaps
from ..style.restyle import Styled
from .captures import SAMPLE, Captures, moved_origin
from .files import read_capture
from .gaussians import cells_of
from .neighbours import CELL_LEVELS, cell_grid, sampled

_LINEAR_OFFSET = 0.055
"""Added to sRGB, it is a power of linear light (IEC 61966-2-1): a gain of light is a factor of the sum."""
_MIN_CELL_OPACITY = 0.5
"""Of either side in a cell that both show (by eye)."""
_MIN_SHARED_CELLS = 24
"""Cells that captures of one place share, at least (by eye)."""
_ENOUGH_SHARED_CELLS = 64
"""Cells of which the median is steady: no coarser ones are asked, in which more is mixed (by eye)."""
_MIN_CORRELATION = 0.4
"""Of brightness in cells that captures of one place share, at least (by eye)."""
_UNUSED_LEVELS = 2
"""Coarsest levels of cells, each of which holds a quarter of a capture and more."""


class _Side(NamedTuple):
    """Gaussians of one of the two sides that are compared."""

    means: Annotated[Tensor, "N 3"]
    colours: Annotated[Tensor, "N 3"]
    """Logarithms, of colours + 0.055."""
    weights: Annotated[Tensor, "N"]
    """Weights by what can be seen, its opacity."""

    def in_cells(
        self, cells: Annotated[Tensor, "N"], count: int
    ) -> tuple[Annotated[Tensor, "C"], Annotated[Tensor, "C 3"]]:
        """The opacity in each of `count` cells, and its mean colour; NaN where there is none."""
        weights = torch.zeros(count).double().index_add_(0, cells, self.weights)
        sums = torch.zeros(count, 3).double().index_add_(0, cells, self.weights[:, None] * self.colours)
        return weights, sums / weights[:, None]


def neighbouring_light(
    captures: Captures, references: Sequence[Path], *, activated: bool = False
) -> Annotated[Tensor, "3"] | None:
    """Gains of colours + 0.055 that take captures to the light of other captures which they overlap or border
    on; `activated` as in `read_capture`.

    Found where both have Gaussians in one cell, so that what only one of them shows has no part in it: the
    median over cells. None where they share too few cells, or where their colours in these have nothing in
    common: then they are not of one place.
    """
    own = _own_side(captures)
    other = _other_side(captures, references, activated)
    low, edge = cell_grid(own.means)
    places = torch.cat([own.means, other.means])
    gain = None
    most = _MIN_SHARED_CELLS - 1
    for level in range(CELL_LEVELS - _UNUSED_LEVELS):
        cells = torch.unique(cells_of(places, low, edge * 2**level), return_inverse=True)[1]
        count = int(cells.max()) + 1
        own_weights, before = own.in_cells(cells[: len(own.means)], count)
        other_weights, after = other.in_cells(cells[len(own.means) :], count)
        both = (own_weights > _MIN_CELL_OPACITY) & (other_weights > _MIN_CELL_OPACITY)
        shared = int(both.sum())
        if shared <= most:
            continue
        brightness = torch.stack([before[both].mean(1), after[both].mean(1)])
        if not torch.corrcoef(brightness)[0, 1] > _MIN_CORRELATION:  # NaN is no correlation
            continue
        gain = (after[both] - before[both]).median(0).values.exp()
        most = shared
        # The smaller the cells, the more alike are the things in them.
        if most >= _ENOUGH_SHARED_CELLS:
            break
    return gain


def _own_side(captures: Captures) -> _Side:
    """The captures, each where it is in the world."""
    own = captures.scene.gaussians
    means = own.means.clone()
    for rows, placement in zip(captures.rows, captures.placements, strict=True):
        means[rows] = placement.back(means[rows])
    return _Side(means, _log_light(own.colours), own.opacities.double())


def _other_side(captures: Captures, references: Sequence[Path], activated: bool) -> _Side:
    """Samples of the references, about the origin of the captures."""
    means = []
    colours = []
    weights = []
    for path in references:
        other = read_capture(path, activated=activated)
        part = sampled(other.gaussians.drawable(), SAMPLE // len(references))
        means.append(part.means + moved_origin(other.origin, captures.scene.origin))
        colours.append(_log_light(part.colours))
        weights.append(part.opacities.double())
    return _Side(torch.cat(means), torch.cat(colours), torch.cat(weights))


def _log_light(colours: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    return (colours.double().clamp(0, 1) + _LINEAR_OFFSET).log()


def light_alone(styled: Styled, gain: Annotated[Tensor, "3"] | None = None) -> Styled:
    """A style as its exposure and white balance alone: one gain a channel, in linear light, for the whole
    scene.

    Without a known `gain` it takes the scene's mean colour, of logarithms, to that of the references: right
    where both are of the same materials.
    """
    style = styled.scene_style
    dictionary = styled.dictionary
    regions = len(style.keys)
    if dictionary.colour_mean is None:
        raise UsageError("--match-light: the style has no colours of photographs; name references")
    if gain is None:
        before = _mean_light(style.region_mean, style.share)
        after = _mean_light(dictionary.colour_mean, code_odds(dictionary))
        gain = (after - before).exp()
    # A factor of colours plus 0.055 is a matrix and an offset of colours.
    matrices = gain.diag().expand(regions, 3, 3)
    offsets = (_LINEAR_OFFSET * (gain - 1)).expand(regions, 3)
    maps = ColourMaps(style, matrices, offsets, 1.0)
    restyle = replace(styled.restyle, colours=maps, light=None, places=())
    return styled._replace(restyle=restyle)


def _mean_light(colours: Annotated[Tensor, "K 3"], shares: Annotated[Tensor, "K"]) -> Annotated[Tensor, "3"]:
    """The mean of logarithms of colours, by their shares."""
    weights = shares.double() / shares.double().sum()
    return weights @ _log_light(colours)
