"""3D Gaussians fitted to a field: trained against the field's own renders, from points on its surfaces.

Geometry is learnt once, from the first look; a further look learns colours alone, so that all of its files hold the same
Gaussians in the same order.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from ..datamanagers.images import Image
from ..datamanagers.scene import Scene
from ..io.images import to_uint8
from ..rendering.cameras import Cameras
from ..splats.config import GaussiansConfig
from ..splats.gaussians import Gaussians
from ..splats.initial import Points
from ..splats.learner import GaussianLearner
from ..splats.photographs import make_levels
from ..splats.training import find_near, reach_of
from ..style.look import Restyle
from ..training.driver import Report, Schedule, learn
from ..training.loading import Trained

_ALIKE = 0.7
"""Cosine between the axes of views that have a view between them."""
_COLOURS = 0.3
"""Time for the colours of a further look, as a share of that for the geometry."""


def fit_gaussians(
    trained: Trained,
    points: Points,
    views: Sequence[int],
    looks: Sequence[Restyle | None],
    *,
    minutes: float,
    cap: int,
    report: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> Iterator[Gaussians]:
    """Gaussians of each look, trained for `minutes` after rendering.

    What is rendered are `views` and as many between them. `points` are where Gaussians begin; at most 0.7 `cap` of them are
    taken, and there are at most `cap` Gaussians in the end.
    """
    # The field is photographed from the views and between them, and learnt like any scene.
    cameras, facts = _with_midpoints(trained.known.cameras.select(torch.tensor(views))), trained.known.facts
    count, every = len(cameras), torch.arange(len(cameras))
    paths = (Path("field"),) * count
    scene = Scene(name="field", paths=paths, cameras=cameras, train=every, test=every[:0])
    draw = np.random.default_rng(trained.config.seed)
    some = np.sort(draw.permutation(len(points.position))[: max(1, round(0.7 * cap))])
    points = Points(points.position[some], points.colour[some])
    near = find_near(scene, points)
    config = GaussiansConfig(cap=cap, seed=trained.config.seed, background=facts.background or (0.0, 0.0, 0.0))
    reach = reach_of(scene)
    learner = None
    for number, look in enumerate(looks):
        images = _renders(trained, cameras, look, report)
        levels = make_levels(scene, images, {}, near)
        # The first look decides the geometry; in further ones the same Gaussians learn their colours at full size.
        if learner is None:
            learner = GaussianLearner(config, levels, reach, cap)
            learner.begin_at(points, draw)
            seconds = 60 * minutes
        else:
            before = learner
            learner = GaussianLearner(replace(config, coarse=0.0), levels, reach, cap, only="colours")
            learner.start_from(before.gaussians())
            seconds = 60 * minutes * _COLOURS
        what = "fitting Gaussians" if number == 0 else "fitting colours"
        learn(learner, None, Schedule(None, seconds / 60), partial(_tell, report, what))
        yield learner.gaussians()


def _tell(report: Callable[[int, int, str], None], what: str, event: Report) -> None:
    report(round(100 * event.share), 100, what)


def _renders(
    trained: Trained, cameras: Cameras, look: Restyle | None, report: Callable[[int, int, str], None]
) -> dict[int, Image]:
    shown, images = trained.restyled(look), {}
    for view in range(len(cameras)):
        report(view, len(cameras), "rendering views")
        images[view] = to_uint8(shown.render(cameras, view).rgb)
    return images


def _with_midpoints(cameras: Cameras) -> Cameras:
    """The views, and one half-way from each to its nearest neighbour that looks about the same way: a field shows any view."""
    pose = cameras.pose
    centre, turns = pose[:, :, 3], pose[:, :, :3]
    alike = torch.einsum("va,wa->vw", turns[:, :, 2], turns[:, :, 2])
    apart = torch.cdist(centre, centre).masked_fill(alike < _ALIKE, torch.inf).fill_diagonal_(torch.inf)
    distance, other = apart.min(1)
    mean = (turns + turns[other]) / 2
    left, _, right = torch.linalg.svd(mean)  # the rotation nearest to the mean
    between = torch.cat([left @ right, ((centre + centre[other]) / 2)[:, :, None]], 2)
    chosen = (distance < torch.inf).nonzero()[:, 0]
    added = replace(cameras, pose=between).select(chosen)
    return Cameras(*(torch.cat([getattr(part, field.name) for part in (cameras, added)]) for field in fields(Cameras)))
