"""Surfaces of Gaussians, their blockers of light, the sky and its openness: found once for all lights."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from ..light.skies import MIN_SKY_HEIGHT, sky_pixels
from ..light.surfaces import Surfaces, find_surfaces
from ..light.transport import Blockers, covariances_of, openness
from ..ops.rasterise.rendering import Pinhole, lift
from ..rendering.cameras import Cameras
from ..rendering.north import world_axes
from .drawing import draw
from .gaussians import Gaussians, bulk_of
from .pinholes import covering
from .relighting import Illumination

_VIEWS = 16
"""Views that surfaces are found in."""
_VIEW_PIXELS = 320
"""Longer side of these, at most."""
_MAX_BLOCKER_DISTANCE = 0.5
"""Distance from the bulk (`Bulk.apart`) up to which Gaussians cast shadows: skies and far surroundings lie
farther out, four scenes from within have theirs at 0.6 and more (by eye).
"""
_MIN_SKY_DISTANCE = 2.0
"""Distance of a sky from the bulk of what lies below the horizon, at least: walls of a street reach 1.8."""
_MIN_GROUND_SHARE = 0.1
"""Of Gaussians that lie below the horizon, at least, for their bulk to be the ground's: of a facade that is seen from
below a few floaters were, and all of it became sky.
"""
_MAX_SPREAD_SHARE = 0.2
"""Distance of a Gaussian from its surface that counts for how thick that is, at most, as a share of that width."""
_MIN_SHOWN_PIXELS = 1e-2
"""Weight of a Gaussian in all views, from which on they say something about it."""
_MIN_LIKENESS = 0.6
"""Likeness to the sky of the pixels of a Gaussian of the sky, at least (by eye)."""


@torch.inference_mode()
def find_illumination(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    antialiased: bool,
    near: float,
    up: tuple[float, float, float] | None = None,
) -> Illumination:
    """Find surfaces, the sky and openness from views; `up` = None takes these for held level."""
    upwards, ahead = world_axes(cameras, up)
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
    count = min(_VIEWS, len(cameras))
    chosen = cameras.select(torch.linspace(0, len(cameras) - 1, count).round().long())
    chosen = chosen.scaled(max(1.0, float(chosen.size.amax()) / _VIEW_PIXELS))
    pinholes = [covering(chosen, view, near) for view in range(count)]
    surfaces = find_surfaces(*shape, pinholes, up=upwards, antialiased=antialiased)
    bulk = bulk_of(gaussians.means.numpy())
    far = torch.from_numpy(bulk.apart > _MAX_BLOCKER_DISTANCE)
    eyes = cameras.pose[:, :, 3].float().mean(0)
    heights = torch.nn.functional.normalize(gaussians.means - eyes, dim=1) @ upwards
    above = heights > MIN_SKY_HEIGHT
    far = far | (above & _behind_ground(gaussians.means, ~above))
    sky = far & above
    # Half of the views tell as much: on the town all of them are 0.02 dB worse, and take 0.6 s more for a plant.
    like, followed, spread = _seen_again(gaussians, surfaces, far, sky, pinholes[::2], upwards, antialiased)
    far = far | sky | ((like > _MIN_LIKENESS) & above)
    sky = sky | ((torch.maximum(like, followed) > _MIN_LIKENESS) & above)
    blockers = blockers_of(gaussians, far)
    found = Illumination(
        surfaces,
        blockers,
        spread,
        torch.ones(len(gaussians)),
        far,
        sky,
        heights,
        upwards,
        ahead,
        gaussians.colours,
    )
    open_ = openness(
        blockers, found.points, surfaces.normals, upwards, found.offset, found.offset, found.blur
    )
    return replace(found, openness=torch.where(sky, torch.ones(()), open_))


def blockers_of(gaussians: Gaussians, far: Annotated[Tensor, "N"]) -> Blockers:
    """Gaussians that cast shadows: all but those that are far."""
    covariances = covariances_of(gaussians.quaternions, gaussians.log_scales)
    return Blockers(gaussians.means[~far], covariances[~far], gaussians.opacities[~far])


def _behind_ground(means: Annotated[Tensor, "N 3"], below: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """Gaussians far outside of all that is below the horizon, bool: where a third of a capture's Gaussians are of the
    sky, they count for its bulk. Nothing where too little is below the horizon.
    """
    if float(below.float().mean()) < _MIN_GROUND_SHARE:
        return torch.zeros_like(below)
    ground = bulk_of(means[below].numpy())
    return torch.from_numpy(ground.distances(means.numpy()) > _MIN_SKY_DISTANCE)


def _seen_again(
    gaussians: Gaussians,
    surfaces: Surfaces,
    far: Annotated[Tensor, "N"],
    sky: Annotated[Tensor, "N"],
    cameras: Sequence[Pinhole],
    up: Annotated[Tensor, "3"],
    antialiased: bool,
) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N"], Annotated[Tensor, "N"]]:
    """Both likenesses to the sky of the pixels that show a Gaussian (`sky_pixels`), in [0, 1], and the thickness of the
    surface there: the mean distance of what they show from it.
    """
    shape = (gaussians.means, gaussians.quaternions, gaussians.log_scales, gaussians.logits)
    away = ((surfaces.points - gaussians.means) * surfaces.normals).sum(1).abs()
    away = torch.minimum(away, _MAX_SPREAD_SHARE * surfaces.widths)
    values = torch.stack([sky.float(), torch.where(far, torch.zeros(()), away)], 1)
    sums = torch.zeros(len(gaussians), 4)
    for camera in cameras:
        drawn = draw(gaussians, camera, antialiased=antialiased, features=values)
        inside = drawn.features / drawn.opacity.clamp_min(1e-3)[..., None]
        sure = torch.where(drawn.opacity > 0.5, inside[..., 0], torch.zeros(()))
        like, followed = sky_pixels(drawn.image.clamp(0, 1), sure, camera, up)
        pixels = torch.stack([like, followed, inside[..., 1], torch.ones_like(like)], -1)
        sums += lift(*shape, camera, pixels.contiguous(), antialiased=antialiased)
    found = sums[:, :3] / sums[:, 3:].clamp_min(_MIN_SHOWN_PIXELS)
    return found[:, 0], found[:, 1], found[:, 2]
