"""3D Gaussians fitted to a field: trained against the field's own renders, from points on its surfaces.

Geometry is learnt once, from the first look; a further look learns colours alone, so that all of its files hold the same
Gaussians in the same order.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ..datamanagers.images import Image
from ..datamanagers.scene import Scene
from ..io.images import to_uint8
from ..splats.config import GaussiansConfig
from ..splats.gaussians import Gaussians
from ..splats.initial import Points
from ..splats.learner import Learner
from ..splats.photographs import make_levels
from ..splats.training import find_near
from ..style.look import Restyle
from ..training.loading import Trained

__all__ = ["fit_gaussians"]

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
    origin: Annotated[Tensor, "3"],
    report: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> Iterator[Gaussians]:
    """Gaussians of each look, their positions relative to `origin`, float32; trained for `minutes` after rendering `views`.

    `points` are where they begin; at most `cap` of them are taken, and there are at most `cap` Gaussians in the end.
    """
    cameras, facts = trained.known.cameras.select(torch.tensor(views)), trained.known.facts
    pose = cameras.pose.clone()
    pose[:, :, 3] -= origin
    cameras = replace(cameras, pose=pose)
    count, every = len(views), torch.arange(len(views))
    paths = (Path("field"),) * count
    scene = Scene(name="field", paths=paths, cameras=cameras, train=every, test=every[:0])
    draw = np.random.default_rng(trained.config.seed)
    some = np.sort(draw.permutation(len(points.position))[: max(1, round(0.7 * cap))])
    points = Points(points.position[some] - origin.numpy(), points.colour[some])
    near = find_near(scene, points)
    config = GaussiansConfig(cap=cap, seed=trained.config.seed, background=facts.background or (0.0, 0.0, 0.0))
    reach = 1.1 * float((pose[:, :, 3] - pose[:, :, 3].mean(0)).norm(dim=1).max()) or 1.0
    learner = None
    for number, look in enumerate(looks):
        images = _renders(trained, views, look, report)
        levels = make_levels(scene, images, {}, near)
        if learner is None:
            learner = Learner(config, levels, reach, cap)
            learner.begin(points, draw)
            seconds = 60 * minutes
        else:
            before = learner
            learner = Learner(replace(config, coarse=0.0), levels, reach, cap, colours_only=True)
            learner.start_from(before.gaussians())
            seconds = 60 * minutes * _COLOURS
        start, step, share = time.perf_counter(), 0, 0.0
        while share < 1:
            learner.step(step, share)
            step, share = step + 1, (time.perf_counter() - start) / seconds
            if step % 50 == 0:
                report(round(100 * min(share, 1)), 100, "fitting Gaussians" if number == 0 else "fitting colours")
        yield learner.gaussians()


def _renders(
    trained: Trained, views: Sequence[int], look: Restyle | None, report: Callable[[int, int, str], None]
) -> dict[int, Image]:
    shown, images = trained.restyled(look), {}
    for number, view in enumerate(views):
        report(number, len(views), "rendering views")
        images[number] = to_uint8(shown.render(trained.known.cameras, view).rgb)
    return images
