"""3D Gaussians fitted to a scene of any kind: trained against its own renders, from points on its surfaces.

Geometry is learnt once, from the first look; a further look learns colours alone, so that all of its files
hold the same Gaussians in the same order.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch

from ..datamanagers.scene import ParsedScene
from ..io.images import to_uint8
from ..progress import Report
from ..rendering.cameras import Cameras, grid_rays
from ..scenes import Scene
from ..splats.config import GaussiansConfig
from ..splats.gaussians import Gaussians
from ..splats.initial import Points
from ..splats.learner import Bounds, GaussianLearner, Stage
from ..splats.photographs import make_levels
from ..splats.setup import find_near, limit_widths, scene_scale
from ..style.look import Restyle
from ..training.driver import Schedule, learn
from .mesh import Maps

_MIN_AXES_COSINE = 0.7
"""Cosine between the axes of views that have a view between them: up to 45 degrees. By eye."""
_COLOURS_TIME_SHARE = 0.3
"""Time for the colours of a further look, as a share of that for the geometry. By eye."""
_FIRST_GAUSSIANS_SHARE = 0.7
"""Gaussians that are there at the start, as a share of the most: learning splits them where it
needs more. By eye."""
_SKY_DISTANCE_RATIO = 3.0
"""Distance of points in the sky, in distances of the outermost of all others from the middle of the views.
By eye."""


def seen_points(maps: Maps, most: int) -> Points:
    """Places and colours of random pixels of views, at most so many; where a view sees nothing, of a dome of
    sky.
    """
    # Where each pixel's ray meets a surface (infinite where none), its direction, and its colour.
    place = []
    colour = []
    middle = maps.cameras.pose[:, :, 3].mean(0)
    for view, depth in enumerate(maps.depth):
        origin, direction = grid_rays(maps.cameras, view)
        place.append(torch.cat([origin + direction * depth.view(-1, 1), direction], 1))
        colour.append(maps.rgb[view].view(-1, 3))
    every = torch.randperm(sum(map(len, place)), generator=torch.Generator().manual_seed(0))[:most]
    (at, direction) = torch.split(torch.cat(place)[every], 3, 1)
    shade = torch.cat(colour)[every]
    # What sees no surface is put on a dome beyond all that there is.
    solid = at.isfinite().all(1)
    if bool(solid.any()):
        far = _SKY_DISTANCE_RATIO * float((at[solid] - middle).norm(dim=1).max())
    else:
        far = 1.0
    return Points(torch.where(solid[:, None], at, middle + far * direction).numpy(), shade.float().numpy())


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Length of the fit, count of Gaussians, and their background."""

    minutes: float
    """Time for the geometry, after rendering; a further look gets a share of it."""
    cap: int
    """Gaussians, at most."""
    background: tuple[float, float, float] | None = None
    """sRGB in [0, 1]; None: black."""


def fit_gaussians(
    scene: Scene,
    views: Cameras,
    maps: Maps,
    looks: Sequence[Restyle | None],
    limits: Limits,
    *,
    report: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> Iterator[Gaussians]:
    """Gaussians of each look, trained within `limits` after rendering.

    What is rendered are `views` and as many between them. Gaussians begin where `maps` of the views have
    surfaces.
    """
    # The scene is photographed from the views and between them, and learnt like any other.
    cameras = _with_midpoints(views)
    every = torch.arange(len(cameras))
    paths = (Path("scene"),) * len(cameras)
    parsed = ParsedScene(name="scene", paths=paths, cameras=cameras, train=every, test=every[:0])
    draw = np.random.default_rng(0)
    points = seen_points(maps, max(1, round(_FIRST_GAUSSIANS_SHARE * limits.cap)))
    near = find_near(parsed, points)
    config = GaussiansConfig(cap=limits.cap, background=limits.background or (0.0, 0.0, 0.0))
    bounds = Bounds(
        room=limits.cap,
        scene_scale=scene_scale(parsed),
        limit_widths=limit_widths(parsed, near, cells=False),
    )
    learner = None
    for number, look in enumerate(looks):
        shown = scene.restyled(look)
        images = {}
        for view in range(len(cameras)):
            report(view, len(cameras), "rendering views")
            images[view] = to_uint8(shown.render(cameras, view).rgb)
        levels = make_levels(parsed, images, {}, near)
        # The first look decides the geometry; in further ones the same Gaussians learn their colours at full
        # size.
        if learner is None:
            learner = GaussianLearner(config, levels, bounds)
            learner.begin_at(points, draw)
            seconds = 60 * limits.minutes
        else:
            before = learner
            colours = Stage(only="colours")
            learner = GaussianLearner(replace(config, coarse=0.0), levels, bounds, stage=colours)
            learner.start_from(before.gaussians())
            seconds = 60 * limits.minutes * _COLOURS_TIME_SHARE
        if number == 0:
            what = "fitting Gaussians"
        else:
            what = "fitting colours"

        def show(event: Report, what: str = what) -> None:
            report(round(100 * event.share), 100, what)

        learn(learner, None, Schedule(None, seconds / 60), show)
        yield learner.gaussians()


def _with_midpoints(cameras: Cameras) -> Cameras:
    """The views, and one half-way from each to its nearest neighbour that looks about the same way: a field
    shows any view.
    """
    pose = cameras.pose
    centre = pose[:, :, 3]
    turns = pose[:, :, :3]
    alike = torch.einsum("va,wa->vw", turns[:, :, 2], turns[:, :, 2])
    apart = (
        torch.cdist(centre, centre).masked_fill(alike < _MIN_AXES_COSINE, torch.inf).fill_diagonal_(torch.inf)
    )
    distance, other = apart.min(1)
    # The rotation nearest to the mean of both, and the middle between their places.
    left, _, right = torch.linalg.svd((turns + turns[other]) / 2)
    between = torch.cat([left @ right, ((centre + centre[other]) / 2)[:, :, None]], 2)
    chosen = (distance < torch.inf).nonzero()[:, 0]
    added = replace(cameras, pose=between).select(chosen)
    joined = []
    for field in fields(Cameras):
        joined.append(torch.cat([getattr(cameras, field.name), getattr(added, field.name)]))
    return Cameras(*joined)
