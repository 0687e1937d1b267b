"""Some of very many Gaussians, and what the others take from those near to them, by cells of space."""

import math
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from .gaussians import Gaussians, bulk_of, cells_of

FINEST_CELLS = 1024
"""Cells along the longest side of the bulk at the finest level: of a room cells of a centimetre (by eye)."""
CELL_LEVELS = 12
"""Levels, each of cells twice as wide: the coarsest is wider than all that the grid holds."""
_MAX_GRID_DISTANCE = 500.0
"""Extents of the bulk from it, beyond which Gaussians do not say where cells begin: twice that fits into 2^20
finest ones.
"""


def sampled(gaussians: Gaussians, most: int) -> Gaussians:
    """At most so many of the Gaussians, at equal steps, and wider by as many as each stands for."""
    count = len(gaussians)
    if count <= most:
        return gaussians
    some = gaussians.select(torch.arange(most) * count // most)
    # What is seen are surfaces: areas grow as the numbers shrink.
    return replace(some, log_scales=some.log_scales + 0.5 * math.log(count / most))


def cell_grid(points: Annotated[Tensor, "N 3"]) -> tuple[Annotated[Tensor, "3"], float]:
    """Lowest corner of the cells around points, and the edge of the finest. Strays are left out: the grid
    cannot reach both.
    """
    bulk = bulk_of(points.numpy())
    near = points[torch.from_numpy(bulk.apart <= _MAX_GRID_DISTANCE)]
    return near.amin(0), (bulk.side or 1.0) / FINEST_CELLS


class Neighbours:
    """Features at places, as the mean of those of the points in the smallest cell around that holds any."""

    def __init__(self, points: Annotated[Tensor, "M 3"], features: Annotated[Tensor, "M D"]) -> None:
        self.low, self.edge = cell_grid(points)
        self.fallback = features.float().mean(0)
        self.levels = []
        for level in range(CELL_LEVELS):
            keys, cell = torch.unique(cells_of(points, self.low, self.edge * 2**level), return_inverse=True)
            # A level has the means of its cells, by the sorted numbers of these.
            sums = torch.zeros(len(keys), features.shape[1]).index_add_(0, cell, features.float())
            self.levels.append((keys, (sums / cell.bincount()[:, None]).half()))

    def __call__(self, places: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Half precision, as semantics are."""
        out = self.fallback.half().expand(len(places), -1).clone()
        left = torch.arange(len(places))
        for level, (keys, means) in enumerate(self.levels):
            cells = cells_of(places[left], self.low, self.edge * 2**level)
            # Those without a cell at this level ask the next, where cells are twice as wide.
            at = torch.searchsorted(keys, cells).clamp_max(len(keys) - 1)
            found = keys[at] == cells
            out[left[found]] = means[at[found]]
            left = left[~found]
        return out
