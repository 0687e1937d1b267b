"""What of a scene is worth cutting: the cameras' footprint with what they commonly see, in the axes of the scene's space.

Sparse points reach as far as the eye does; most of a scene's detail lies where its cameras are. So the region is the cameras'
bounds widened by REACH, but no wider than the points there are.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..types import Site

__all__ = ["FEW", "REACH", "bounds", "within"]

REACH = 1.0
"""Units beyond the cameras that still belong to the region; a unit is the distance that views commonly see."""
OUTLIERS = 0.01
"""Share of the points on either side that is left out: reconstructions have strays."""
FEW = 16
"""Fewer points than these say nothing about bounds."""
PADDING = 0.05
"""Bounds found from points are this much wider (share of their size): surfaces must not lie on the border."""


def bounds(site: Site) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
    """Lowest and highest corner of the region."""
    low, high = site.position.amin(0) - REACH, site.position.amax(0) + REACH
    return within(site, low, high)


def within(
    site: Site, low: Annotated[Tensor, "3"], high: Annotated[Tensor, "3"], points: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The box shrunk to the points inside it, as far as all cameras inside stay there with some room."""
    points = site.points if points is None else points
    inside = points[((points >= low) & (points <= high)).all(1)]
    if len(inside) < FEW:
        return low, high
    ends = inside.quantile(torch.tensor([OUTLIERS, 1 - OUTLIERS], dtype=inside.dtype), 0)
    room = PADDING * (ends[1] - ends[0]) + 1e-6
    here = site.position[((site.position >= low) & (site.position <= high)).all(1)]
    least = here.amin(0) if len(here) else ends[0]
    most = here.amax(0) if len(here) else ends[1]
    return torch.maximum(low, torch.minimum(ends[0], least) - room), torch.minimum(high, torch.maximum(ends[1], most) + room)
