"""Files of Gaussians whose numbers are activated already: opacities after the sigmoid, sizes after the
exponential, colours in the place of the constant harmonics.

Formats of raw numbers do not say so, and read as they are meant to be such files look like captures of haze.
Each of the three is told by itself: training leaves each of them outside the range of the other meaning.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from ..ops.harmonics import HARMONIC
from .gaussians import Gaussians

_MIN_GAUSSIANS = 16
"""Fewer may be in a range by chance."""
_ROUNDING = 1 / 64
"""Beyond a range, that eight bits of a compressed format may add."""
_MIN_COLOUR_SPAN = 0.25
"""Of colours in [0, 1], at least: read as harmonics they span 0.07, as nothing but a grey plane does (by
eye).
"""
_MIN_MEDIAN_BYTE = 4.0
"""Of colours in [0, 255], at least: as harmonics half of all would be 1.6 times white."""
_MAX_BYTE = 255.0
"""White, of colours as bytes."""
_MIN_LARGEST_OPACITY = 1 / 255
"""Of the most opaque Gaussian: as opacities of nothing but transparent ones they would make no sense."""
_MIN_SIZE = 1e-30
"""Sizes are at least this, so that their logarithm is finite."""
_MIN_COLOUR_SHARE = 1e-6
"""Opacities of exactly 0 and 1 have no logit: both keep this distance, as in `files.base`."""
TYPICAL_LN_SIZE = -0.5
"""ln of the middle axis of Gaussians over the distance to the nearest neighbour: -0.2 to -0.9 in trained
captures.
"""
_ASKED_NEIGHBOURS = 64
"""Gaussians whose nearest neighbours are looked for."""
_CHUNK_ROWS = 1 << 17
"""Gaussians whose distances are found at a time."""


@dataclass(frozen=True)
class Activation:
    """Numbers of a file that look activated, or are read so."""

    opacities: bool = False
    sizes: bool = False
    colours: float = 0.0
    """The number that stands for white, 1 or 255; 0 where they are harmonics."""

    def __bool__(self) -> bool:
        return self.opacities or self.sizes or self.colours > 0

    def __str__(self) -> str:
        """Activated numbers, as a phrase."""
        parts = []
        if self.opacities:
            parts.append("opacities all in [0, 1]")
        if self.sizes:
            parts.append("sizes all positive, about as wide as neighbours are apart")
        if self.colours:
            parts.append(f"colours all in [0, {self.colours:g}]")
        return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


def find_activation(gaussians: Gaussians, *, asked: bool = False) -> Activation:
    """Numbers of Gaussians, as they were read, that look activated. `asked`: somebody says so, and what may
    be either is taken so, such as colours of one grey.
    """
    if len(gaussians) < _MIN_GAUSSIANS and not asked:
        return Activation()
    logits = gaussians.logits[gaussians.logits.isfinite()]
    constants = gaussians.harmonics[:, 0]
    constants = constants[constants.isfinite()]
    opacities = _within(logits, 1.0) and float(logits.max()) > _MIN_LARGEST_OPACITY
    return Activation(opacities, _are_sizes(gaussians), _white_of(constants, asked))


def activated(gaussians: Gaussians, found: Activation) -> Gaussians:
    """The Gaussians that a file means whose numbers are activated."""
    if found.opacities:
        inside = gaussians.logits.double().clamp(_MIN_COLOUR_SHARE, 1 - _MIN_COLOUR_SHARE)
        gaussians = replace(gaussians, logits=torch.logit(inside).float())
    if found.sizes:
        sizes = gaussians.log_scales
        flat = sizes == -torch.inf  # the missing axis of 2D Gaussians
        ln_sizes = torch.where(flat, sizes, sizes.clamp_min(_MIN_SIZE).log())
        gaussians = replace(gaussians, log_scales=torch.where(sizes.isnan(), sizes, ln_sizes))
    if found.colours:
        constants = (gaussians.harmonics[:, :1] / found.colours - 0.5) / HARMONIC
        gaussians = gaussians.recoloured(torch.cat([constants, gaussians.harmonics[:, 1:]], 1))
    return gaussians


def file_harmonics(harmonics: Annotated[Tensor, "N K 3"], found: Activation) -> Annotated[Tensor, "N K 3"]:
    """Harmonics as such a file has them: its colours stay in their range."""
    if not found.colours:
        return harmonics
    constants = (harmonics[:, :1] * HARMONIC + 0.5).clamp(0, 1) * found.colours
    return torch.cat([constants, harmonics[:, 1:]], 1)


def nearest_distance(points: Annotated[Tensor, "N 3"]) -> float | None:
    """Median distance from some of the points to their nearest neighbours elsewhere; None where all are in
    one place.
    """
    asked = points[torch.linspace(0, max(len(points) - 1, 0), _ASKED_NEIGHBOURS).long()].double()
    asked = asked[asked.isfinite().all(1)]
    if not len(asked):
        return None
    nearest = torch.full((len(asked),), torch.inf)
    for some in torch.split(points, _CHUNK_ROWS):
        # About the first one, so that float32 keeps the digits of places far from 0.
        apart = torch.cdist(
            (asked - asked[:1]).float(),
            (some.double() - asked[:1]).float(),
            compute_mode="donot_use_mm_for_euclid_dist",
        )
        nearest = torch.minimum(nearest, apart.masked_fill(~(apart > 0), torch.inf).amin(1))
    nearest = nearest[nearest.isfinite()]
    if not len(nearest):
        return None
    return float(nearest.median())


def _within(values: Tensor, most: float) -> bool:
    """True where there are values, all of them in [0, most]."""
    if not len(values):
        return False
    return float(values.min()) >= -_ROUNDING and float(values.max()) <= most + _ROUNDING


def _are_sizes(gaussians: Gaussians) -> bool:
    """True where ln-scales are sizes: none is negative, and as sizes they suit the distances of neighbours
    better. Captures in millimetres have ln-scales above 0, too.
    """
    scales = gaussians.log_scales
    if bool(((scales < 0) & scales.isfinite()).any()):
        return False
    scales = scales[:, (scales != -torch.inf).any(0)]  # without the missing axis of 2D Gaussians
    known = scales[scales.isfinite().all(1)]
    if not known.numel() or float(known.max()) == 0:
        return False
    spacing = nearest_distance(gaussians.means)
    if spacing is None:
        return False
    middle = float(known.sort(1).values[:, -2:].amin(1).median())
    as_logarithm = middle - math.log(spacing)
    as_size = math.log(max(middle, _MIN_SIZE)) - math.log(spacing)
    return abs(as_size - TYPICAL_LN_SIZE) < abs(as_logarithm - TYPICAL_LN_SIZE)


def _white_of(constants: Annotated[Tensor, "M"], asked: bool) -> float:
    """1 or 255 where constant harmonics are colours of that white; 0 where they are none."""
    if _within(constants, 1.0):
        span = float(constants.max() - constants.min())
        return 1.0 if asked or span >= _MIN_COLOUR_SPAN else 0.0
    if _within(constants, _MAX_BYTE) and float(constants.median()) > _MIN_MEDIAN_BYTE:
        return _MAX_BYTE
    return 0.0
