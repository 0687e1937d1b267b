"""Build a `GaussianLearner` from photographs: their levels of size, first points, limits of widths.

Shapes: N Gaussians, P points, V views, M training views. World axes and units are the capture's own, relative
to its origin. Lengths that are needed before anything is learnt follow from the cameras and the sparse
points:

    scene scale    how far the cameras stand apart; the means' learning rate is in proportion to it
    near           distance along z below which nothing is drawn
    width          standard deviation along an axis of a Gaussian; bounded by the distance to the nearest camera
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..datamanagers.images import Image
from ..datamanagers.scene import ParsedScene, find_sightings, sparser
from ..ops.rasterise.gsplat import Trainable
from ..ops.rasterise.training import LOG_SCALES, MEANS
from ..training.camera_optimizers import poses_of, tones_of
from ..training.facts import Facts
from ..training.prepare import exposure_of, facts_of
from ..training.run import known_of
from .config import GaussiansConfig
from .initial import Points, initial_points, projected, surroundings
from .learner import CPU, Bounds, GaussianLearner, LimitWidths, RunSource
from .photographs import load_photographs, make_levels
from .view_corrections import ViewCorrections

_MIN_GAUSSIANS_PER_SURROUNDING = 10
"""Gaussians for one of the surroundings, at least; by eye."""
_MAX_SURROUNDING_WIDTH = 0.2
"""Greatest width of the surroundings, in radii of their sphere; by eye."""
_MAX_INSIDE_DISTANCE = 0.5
"""Distance from the middle of the sphere, in its radii, up to which Gaussians are none of the surroundings; by
eye: the sphere is ten times as large as the scene.
"""
_MAX_WIDTH = 0.5
"""Greatest width of all others, in distances to the nearest camera; by eye: wider ones are haze."""
_MAX_WIDTH_IN_CELLS = 0.25
"""The same in scenes of cells, each of whose photographs is seen rarely; by eye."""
_WIDTH_EVERY_STEPS = 20
"""Steps between cuts of widths; by eye."""
_WIDTH_EVERY_STEPS_IN_CELLS = 100
"""The same in scenes of cells, where there are more cameras to measure distances to; by eye."""
_SPHERE_EVERY_STEPS = 10
"""Steps between cuts of the surroundings, which takes next to no time; by eye."""
_MIN_GAUSSIANS_AT_ONCE = 256
"""Gaussians whose distances to cameras are taken together, at least; by eye."""
_MAX_PAIRS_AT_ONCE = 1 << 16
"""Pairs of Gaussians and cameras whose distances are taken together, where cameras are few; by eye."""
_MAX_NEAR_POINTS = 4000
"""Points that say how near to a camera things are, at most: enough for a quantile of all."""
_MAX_NEAR_DEPTHS = 10_000_000
"""Depths of these points in all views that are sorted, at most: bounds the memory."""
_NEAR_SHARE = 0.25
"""The near plane as a share of the distance that all but 1 % of the points in view have; by eye: haze right
before a lens is nearer.
"""
_NEAR_UNSEEN_SHARE = 1e-3
"""The near plane as a share of the scene scale, where no view has any point; by eye."""


def build(
    config: GaussiansConfig,
    scene: ParsedScene,
    saved: Facts | None = None,
    *,
    device: torch.device = CPU,
) -> GaussianLearner:
    """Load photographs, find the first points, and put a Gaussian at each; arguments as of
    `RunConfig.build`.
    """
    # Few photographs get few Gaussians, which they would else learn by heart; cells bound theirs by the whole
    # scene.
    if not config.cells.cuts:
        pixels = int(scene.cameras.size[scene.train].prod(1).sum())
        cap = max(1, min(config.most, pixels // config.pixels_per_gaussian))
        config = replace(config, cap=cap, initial=max(1, config.initial * cap // config.most))
    config = replace(
        config, surroundings=min(config.surroundings, config.most // _MIN_GAUSSIANS_PER_SURROUNDING)
    )
    images, masks, skies = load_photographs(config, scene, scene.train.tolist())
    facts = saved or light_and_poses(config, scene, lambda view: images[view])
    # Gaussians begin at points of the reconstruction, or at matches between views ...
    draw = np.random.default_rng((config.seed, 0))
    points, origin = initial_points(scene, images, config.initial, draw)
    # ... and on a sphere around everything, which stays coarse: only what it encloses is split.
    far = None
    sphere = None
    if config.surroundings:
        far = surroundings(scene, images, points, config.surroundings)
        centre = torch.from_numpy(far.position.mean(0)).float()
        sphere = _Sphere(centre, float((torch.from_numpy(far.position).float() - centre).norm(dim=1).min()))
    near = find_near(scene, points)
    learner = GaussianLearner(
        config,
        make_levels(scene, images, masks, near, skies, device=device),
        Bounds(
            room=max(config.most, len(points.position) + config.surroundings),
            scene_scale=scene_scale(scene),
            near=near,
            inside=None if sphere is None else sphere.encloses,
            limit_widths=limit_widths(scene, near, cells=config.cells.cuts, sphere=sphere),
        ),
        corrections=ViewCorrections(tones_of(facts), poses_of(facts, 1.0), decided=config.poses is not None),
        source=RunSource(known=known_of(scene, config.data, facts), points=origin),
        opaque=not scene.alpha,
        device=device,
    )
    learner.begin_at(points, draw, far)
    return learner


def light_and_poses(config: GaussiansConfig, scene: ParsedScene, image: Callable[[int], Image]) -> Facts:
    """Facts of a scene with exposures and places of the views, where these are learnt; `image(view)` is a
    training view.
    """
    exposure = exposure_of(config.tones, scene, lambda view: torch.from_numpy(image(view)).float() / 255)
    return facts_of(scene, config.background, exposure=exposure, poses=config.may_refine)


class _Sphere(NamedTuple):
    """The sphere that the surroundings begin on."""

    centre: Annotated[Tensor, "3"]
    radius: float

    def encloses(self, means: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """Mask of the means that lie well within."""
        apart: Tensor = (means - self.centre).norm(dim=1)
        return apart < _MAX_INSIDE_DISTANCE * self.radius


def limit_widths(
    scene: ParsedScene, near: float, *, cells: bool, sphere: _Sphere | None = None
) -> LimitWidths:
    """Keep Gaussians narrower than a share of the distance to the nearest training camera, and the
    surroundings thin.

    What reaches a camera is drawn before the whole scene as haze, and mixes the semantics of everything. Of
    thousands of photographs each is seen rarely, so scenes of cells have a lower limit. Nothing nearer than
    `near` is drawn.
    """
    centres = scene.cameras.pose[scene.train][:, :, 3].float().contiguous()
    share = _MAX_WIDTH_IN_CELLS if cells else _MAX_WIDTH
    if cells:
        every = _WIDTH_EVERY_STEPS_IN_CELLS
    else:
        every = _WIDTH_EVERY_STEPS

    def nearest_camera(points: Annotated[Tensor, "P 3"]) -> Annotated[Tensor, "P"]:
        # Points lie within a ball, so the camera nearest to one of them is among those nearest to its centre.
        middle = (points.amin(0) + points.amax(0)) / 2
        radius = (points - middle).norm(dim=1).amax()
        apart = (centres - middle).norm(dim=1)
        some = centres[apart <= 1.001 * (apart.amin() + 2 * radius)]
        return torch.cdist(points, some, compute_mode="donot_use_mm_for_euclid_dist").amin(1)

    def limit(gaussians: Trainable, step: int) -> None:
        # Seen from beside, a wide one of the surroundings would be drawn before the scene.
        if sphere is not None and step % _SPHERE_EVERY_STEPS == 0:
            apart = gaussians.read(MEANS) - sphere.centre.numpy()
            far = np.flatnonzero(
                np.einsum("nk,nk->n", apart, apart) >= (_MAX_INSIDE_DISTANCE * sphere.radius) ** 2
            )
            gaussians.limit_scales(
                np.full(len(far), math.log(_MAX_SURROUNDING_WIDTH * sphere.radius), np.float32), far
            )
        # What is narrower than the share of `near` is narrow enough everywhere that it is drawn: distances
        # cost time.
        if step % every == 0:
            wide = np.flatnonzero(gaussians.read(LOG_SCALES).max(1) > math.log(share * near))
            if len(wide):
                points = torch.from_numpy(gaussians.read(MEANS, wide))
                together = max(_MIN_GAUSSIANS_AT_ONCE, _MAX_PAIRS_AT_ONCE // len(centres))
                parts = []
                for part in torch.split(points, together):
                    parts.append(nearest_camera(part))
                distance = torch.cat(parts)
                gaussians.limit_scales((share * distance).clamp_min(1e-12).log().numpy(), wide)

    return limit


def scene_scale(scene: ParsedScene) -> float:
    """Unit of the means' learning rate: the radius of the training cameras' positions.

    At most the distance at which views commonly see points, where the capture knows: steps in proportion to
    the radius of a district scatter what its views show.
    """
    around = scene.cameras.pose[scene.train][:, :, 3]
    radius = 1.1 * float((around - around.mean(0)).norm(dim=1).max()) or 1.0
    sightings = find_sightings(sparser(scene))
    if sightings is None:
        return radius
    return min(radius, float(sightings.distance.median()))


def find_near(scene: ParsedScene, points: Points) -> float:
    """Near plane: a quarter of the depth that 99 % of the points exceed, so that haze right before a lens is
    not drawn.

    Of some of the points and depths, evenly spread; where no view has any, a thousandth of the scene scale.
    """
    some = torch.from_numpy(points.position[:: -(-len(points.position) // _MAX_NEAR_POINTS)])
    parts = []
    for _, _, depth, inside in projected(scene, some):
        parts.append(depth[inside])
    seen = torch.cat(parts)
    if not len(seen):
        return _NEAR_UNSEEN_SHARE * scene_scale(scene)
    return _NEAR_SHARE * float(seen[:: -(-len(seen) // _MAX_NEAR_DEPTHS)].quantile(0.01))
