"""The space of a scene that is cut into blocks: level axes, recentred, in units of what its views see.

Rays, sample spacing and density live here, the same for all blocks, so that densities blend as they are; each block maps the
points of this space to its own unit cube.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.scene import Scene, Sightings
from ..errors import DataError
from ..rendering.bounds import FAR, NEAR, ROUNDING, axes
from ..rendering.cameras import Cameras
from ..rendering.space import Space
from ..types import Site

__all__ = ["level_axes", "open_space", "site_of"]

FLAT = 0.3
"""Cameras spread over a plane if their third extent is below this share of their second ..."""
WIDE = 0.2
"""... and that one above this share of the first."""
NEAREST = 0.001
"""Share of the sightings that may lie closer than twice the nearest distance that is looked at."""
SPACINGS = 10.0
"""Without points views are taken to see this many times the distance to the next camera ..."""
SOME = 512
"""... which is measured for about so many of them."""


def level_axes(cameras: Cameras) -> Annotated[Tensor, "3 3"]:
    """Rows: along the capture, across, up. Over a plane (drones) its normal is up; along a line (streets) the cameras' own."""
    offset = cameras.pose[:, :, 3] - cameras.pose[:, :, 3].mean(0)
    _, extent, rows = torch.linalg.svd(offset, full_matrices=True)
    if len(extent) < 3 or extent[2] > FLAT * extent[1] or extent[1] < WIDE * extent[0]:
        return axes(cameras)
    up, along = rows[2], rows[0]
    upright, ahead = cameras.pose[:, :, 1].mean(0), -cameras.pose[:, :, 2].mean(0)
    # Cameras stand upright, or look down: one of the two tells which side of the plane the sky is on.
    if (upright @ up - ahead @ up) < 0:
        up = -up
    if offset[-1] @ along < offset[0] @ along:
        along = -along
    return torch.stack([along, torch.linalg.cross(up, along), up])


def open_space(scene: Scene, sightings: Sightings | None) -> Space:
    """The space of kind `open`. Raises DataError where all cameras stand in one place and nothing says how far they see."""
    position = scene.cameras.pose[:, :, 3]
    centre, turn = position.mean(0), level_axes(scene.cameras)
    nearest = None
    if sightings is not None:
        unit = float(sightings.distance.median())
        nearest = float(sightings.distance.sort().values[int(NEAREST * len(sightings.distance))])
    elif scene.depths is not None:
        unit, nearest = float(scene.depths.prod(-1).sqrt().median()), float(scene.depths[:, 0].amin())
    else:
        apart = torch.cdist(position[:: max(1, len(position) // SOME)], position)
        unit = SPACINGS * float(apart.topk(2, largest=False).values[:, 1].median()) if len(position) > 1 else 0.0
    if unit <= ROUNDING * max(1.0, float(position.abs().amax())):
        raise DataError(f"{scene.name}: all cameras stand in one place and there are no points; capture from several places")
    near = NEAR if nearest is None else min(NEAR, max(1e-3, 0.5 * nearest / unit))
    first, second, third = ((float(row[0]), float(row[1]), float(row[2])) for row in turn)
    middle = (float(centre[0]), float(centre[1]), float(centre[2]))
    return Space("open", middle, (first, second, third), 1 / unit, near, FAR)


def site_of(scene: Scene, space: Space) -> Site:
    """Training cameras and sparse points in the space."""
    turn = torch.tensor(space.rotation, dtype=torch.float64)
    centre = torch.tensor(space.centre, dtype=torch.float64)
    cameras = scene.cameras.select(scene.train)
    points = scene.points if scene.points is not None else centre.new_zeros(0, 3)
    return Site(
        ((cameras.pose[:, :, 3] - centre) @ turn.T) * space.scale,
        cameras.size.prod(-1),
        ((points - centre) @ turn.T) * space.scale,
        1 / space.scale,
    )
