"""What training 3D Gaussians from photographs begins with: first points, photographs at all scales, limits of their sizes."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..datamanagers.images import Image
from ..datamanagers.scene import Scene, find_sightings, sparser
from ..ops.rasterise_training import LOG_SCALES, MEANS, TrainableGaussians, compile_beside
from ..training.model import Facts, poses_of, tones_of
from ..training.prepare import exposure_of, facts_of
from ..training.run import known_of
from .config import GaussiansConfig
from .initial import Points, initial_points, projected, surroundings
from .learner import GaussianLearner, Narrow
from .photographs import Floats, load_photographs, load_skies, make_levels

_SURROUNDINGS = 10
"""Gaussians, at most, for one of the surroundings."""
_WIDE = 0.2
"""Greatest standard deviation of one of them, as a share of their distance."""
_CLEAR, _CLEAR_CELLS, _TOGETHER = 0.5, 0.25, 256
"""Greatest standard deviation as a share of the distance to the nearest camera, and in scenes of cells; Gaussians whose
distances are taken together."""
_SOME = 4000
"""Points whose depths say how near to a camera things are."""
_NEAR = 0.25
"""Of the distance that all but 1 % of the points in view have: nothing is drawn nearer to a camera."""
_NEAR_UNSEEN, _DEPTHS = 1e-3, 10_000_000
"""The same where no view has any point, in the radius of the cameras; depths that are looked at, at most."""


def build(
    config: GaussiansConfig,
    scene: Scene,
    saved: Facts | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> GaussianLearner:
    """Load photographs, find the first points, and put a Gaussian at each; arguments as of `RunConfig.build`."""
    compiling = compile_beside((config.degree + 1) ** 2)  # while images are read
    # Few photographs get few Gaussians, which they would else learn by heart; cells bound theirs by the whole scene.
    if config.cells == 1:
        pixels = int(scene.cameras.size[scene.train].prod(1).sum())
        cap = max(1, min(config.most, pixels // config.pixels_per_gaussian))
        config = replace(config, cap=cap, initial=max(1, config.initial * cap // config.most))
    config = replace(config, surroundings=min(config.surroundings, config.most // _SURROUNDINGS))
    images, masks = load_photographs(config, scene, scene.train.tolist())
    facts = saved or lit_facts(config, scene, lambda view: images[view])
    # Gaussians begin at points of the reconstruction, or at matches between views, and on a sphere around everything.
    draw = np.random.default_rng((config.seed, 0))
    points, origin = initial_points(scene, images, config.initial, draw)
    far, sphere = None, None
    if config.surroundings:
        far = surroundings(scene, images, points, config.surroundings)
        centre = torch.from_numpy(far.position.mean(0)).float()
        sphere = _Sphere(centre, float((torch.from_numpy(far.position).float() - centre).norm(dim=1).min()))
    near = find_near(scene, points)
    learner = GaussianLearner(
        config,
        make_levels(scene, images, masks, near, load_skies(config, scene, images)),
        reach_of(scene),
        max(config.most, len(points.position) + config.surroundings),
        None if sphere is None else sphere.encloses,
        limit_widths(scene, near, cells=config.cells > 1, sphere=sphere),
        near=near,
        tones=tones_of(facts),
        poses=poses_of(facts, 1.0),
        known=known_of(scene, config.data, facts),
        origin=origin,
    )
    learner.begin_at(points, draw, far)
    if compiling and progress is not None:
        progress(0, 1, "compiling kernels, once after installation")
    for process in compiling:
        process.wait()
    return learner


def lit_facts(config: GaussiansConfig, scene: Scene, image: Callable[[int], Image]) -> Facts:
    """Facts of a scene with exposures and places of the views, where they are learnt; `image(view)` is a training view."""
    exposure = exposure_of(config.tones, scene, lambda view: torch.from_numpy(image(view)).float() / 255)
    return facts_of(scene, config.background, exposure=exposure, poses=config.poses > 0)


class _Sphere(NamedTuple):
    """The sphere of the surroundings, which stay coarse (only what it encloses is split) and thin."""

    centre: Annotated[Tensor, "3"]
    radius: float

    def encloses(self, means: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """Whether means lie well within."""
        apart: Tensor = (means - self.centre).norm(dim=1)
        return apart < 0.5 * self.radius

    def widest(self, means: Annotated[Floats, "N 3"]) -> Annotated[Floats, "N"]:
        """Logarithms of the greatest standard deviations."""
        square = np.square(means - self.centre.numpy()).sum(1)
        return np.where(square < (0.5 * self.radius) ** 2, np.float32(np.inf), np.float32(math.log(_WIDE * self.radius)))


def limit_widths(scene: Scene, near: float, *, cells: bool, sphere: _Sphere | None = None) -> Narrow:
    """Keep standard deviations below a share of the distance to the nearest training camera.

    What reaches a camera is drawn before the whole scene as haze, and mixes the semantics of everything. Of thousands of
    photographs each is seen rarely, so scenes of cells have a lower limit. Nothing nearer than `near` is drawn.
    """
    centres = scene.cameras.pose[scene.train][:, :, 3].float().contiguous()
    share, every = (_CLEAR_CELLS, 100) if cells else (_CLEAR, 20)

    def nearest(points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        # Points lie within a ball, so the camera nearest to one of them is among those nearest to its centre.
        middle = (points.amin(0) + points.amax(0)) / 2
        radius, apart = (points - middle).norm(dim=1).amax(), (centres - middle).norm(dim=1)
        some = centres[apart <= 1.001 * (apart.amin() + 2 * radius)]
        return torch.cdist(points, some, compute_mode="donot_use_mm_for_euclid_dist").amin(1)

    def narrow(gaussians: TrainableGaussians, step: int) -> None:
        # The surroundings stay thin: seen from beside, a wide one would be drawn before the scene.
        if sphere is not None and step % 10 == 0:
            gaussians.limit_scales(sphere.widest(gaussians.read(MEANS)))
        if step % every:
            return
        # Only what is wider than the share of `near` can be too wide anywhere.
        wide = np.flatnonzero(gaussians.read(LOG_SCALES).max(1) > math.log(share * near))
        if len(wide):
            points = torch.from_numpy(gaussians.read(MEANS, wide))
            widest = torch.cat([share * nearest(part) for part in torch.split(points, _TOGETHER)]).clamp_min(1e-12).log()
            gaussians.limit_scales(widest.numpy(), wide)

    return narrow


def reach_of(scene: Scene) -> float:
    """Unit of the means' learning rate: the radius of the training cameras' positions.

    At most the distance at which views commonly see points, where the capture knows: steps in proportion to the radius of a
    district scatter what its views show.
    """
    around = scene.cameras.pose[scene.train][:, :, 3]
    reach = 1.1 * float((around - around.mean(0)).norm(dim=1).max()) or 1.0
    sightings = find_sightings(sparser(scene))
    return reach if sightings is None else min(reach, float(sightings.distance.median()))


def find_near(scene: Scene, points: Points) -> float:
    """Distance from cameras, along z, from which on things are drawn: below that at which all but 1 % of the points lie."""
    some = torch.from_numpy(points.position[:: -(-len(points.position) // _SOME)])
    seen = torch.cat([depth[inside] for _, _, depth, inside in projected(scene, some)])
    if not len(seen):
        return _NEAR_UNSEEN * reach_of(scene)
    return _NEAR * float(seen[:: -(-len(seen) // _DEPTHS)].quantile(0.01))
