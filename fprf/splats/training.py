"""From a scene folder to trained 3D Gaussians in a run folder, and back from there."""

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..datamanagers.bounds import find_space
from ..datamanagers.images import Image, load_images, load_mask
from ..datamanagers.parsers.config import parse_scene
from ..datamanagers.scene import Scene, at_origin, find_sightings, sparser
from ..errors import CheckpointError, NumericsError, UsageError
from ..interfaces import Encoder
from ..ops.rasterise_training import LOG_SCALES, MEANS, TrainableGaussians
from ..rendering.cameras import Cameras
from ..training import checkpoint
from ..training.camera_optimizers import Poses, Tones, moved_cameras
from ..training.loading import LoadedRun
from ..training.loop import held_back, progress
from ..training.model import Facts, tones_of
from ..training.prepare import exposure_of
from ..training.prepare import reach_of as sight_distance
from ..training.quality import PRESETS, QualityConfig, mixed_tone
from ..training.run import Known, Run
from ..training.trainer import REPORT_SECONDS, Report
from .config import GaussiansConfig
from .gaussians import Gaussians
from .initial import Points, initial_points, projected, surroundings
from .learner import MOVES, Learner, Narrow, Step
from .levels import Levels, make_levels_of_detail, open_levels, write_levels
from .photographs import Floats, make_levels
from .scene import Semantics, SplatScene, find_semantics, load_semantics, semantics_tensors

_PATIENCE = 3
"""Steps in a row without a finite loss after which training gives up."""
_SMOOTHING = 0.95
_VIEWS = 32
"""Training views that semantics are found in, at most."""
_PIXELS = 640 * 360
"""Of an image, where nobody says how far to reduce them."""
_SURROUNDINGS = 10
"""Gaussians, at most, for one of the surroundings."""
_WIDE = 0.2
"""Greatest standard deviation of one of them, as a share of their distance."""
_CLEAR, _CLEAR_CELLS, _TOGETHER = 0.5, 0.25, 256
"""Greatest standard deviation as a share of the distance to the nearest camera, and in scenes of cells; Gaussians whose
distances are taken together."""
_FIT_RATE, _FIT_STEPS = 2e-3, 120
"""Of the poses of views that the scene is not learnt from: `GaussiansConfig.poses`, and steps of each view."""
_SOME = 4000
"""Points whose depths say how near to a camera things are."""
_LEVELS, _MANY = "levels", 400_000
"""Folder of a run; Gaussians from which on levels of detail are kept there and mapped, not made in memory."""
_NEAR = 0.25
"""Of the distance that all but 1 % of the points in view have: nothing is drawn nearer to a camera."""
_NEAR_UNSEEN, _DEPTHS = 1e-3, 10_000_000
"""The same where no view has any point, in the radius of the cameras; depths that are looked at, at most."""


class Prepared(NamedTuple):
    """A scene ready to be trained."""

    scene: Scene
    learner: Learner
    near: float
    origin: str
    """Origin of the first Gaussians."""
    before: int = 0
    """Steps that the Gaussians were trained for elsewhere."""
    shares: tuple[float, float] = (0.0, 1.0)
    """The part of the schedule that is trained here."""
    facts: Facts | None = None
    """Facts of the whole scene, where it is whole."""


def scene_of(config: GaussiansConfig, saved: Facts | None = None) -> Scene:
    """The scene of a config, at its size, about the origin of a run that goes on (`saved`).

    Raises UsageError where it names none, DataError where that cannot be read.
    """
    if config.data is None:
        raise UsageError("no scene is named: give --data FOLDER, or --data garden for the embedded one")
    scene = parse_scene(config.data, config.downscale or 1, config.parser)
    return scene if saved is None else at_origin(scene, saved.origin)


def with_downscale(config: GaussiansConfig) -> GaussiansConfig:
    """The config with the size of its images decided: the smallest factor at which none has more pixels than 640 x 360."""
    if config.downscale is not None:
        return config
    pixels = int(scene_of(config).cameras.size.prod(1).max())
    return replace(config, downscale=max(1, math.ceil(math.sqrt(pixels / _PIXELS))))


def _bounded(config: GaussiansConfig, scene: Scene) -> GaussiansConfig:
    """The config with few surroundings; in one piece with no more Gaussians than there are photographed pixels for."""
    if config.cells == 1:
        pixels = int(scene.cameras.size[scene.train].prod(1).sum())
        cap = max(1, min(config.cap, pixels // config.pixels_per_gaussian))
        config = replace(config, cap=cap, initial=max(1, config.initial * cap // config.cap))
    return replace(config, surroundings=min(config.surroundings, config.cap // _SURROUNDINGS))


def prepare(config: GaussiansConfig, scene: Scene, saved: Facts | None = None) -> Prepared:
    """Load photographs and find the first points.

    `saved` are the facts of a run that goes on: its exposures are not measured again.
    """
    config = _bounded(config, scene)
    images, masks = load_photographs(config, scene, scene.train.tolist())
    facts = saved or lit(facts_of(config, scene), config, scene, lambda view: images[view])
    draw = np.random.default_rng((config.seed, 0))
    points, origin = initial_points(scene, images, config.initial, draw)
    near = find_near(scene, points)
    far = surroundings(scene, images, points, config.surroundings) if config.surroundings else None
    room = max(config.cap, len(points.position) + config.surroundings)
    sphere = _Sphere.around(far) if far is not None else None
    levels = make_levels(scene, images, masks, near, load_skies(config, scene, images))
    inside = None if sphere is None else sphere.encloses
    narrow = limit_widths(scene, near, cells=config.cells > 1, sphere=sphere)
    learner = Learner(config, levels, reach_of(scene), room, inside, narrow, tones=tones_of(facts), poses=poses_of(facts))
    learner.begin(points, draw, far)
    return Prepared(scene, learner, near, origin, facts=facts)


class _Sphere(NamedTuple):
    """The sphere of the surroundings, which stay coarse (only what it encloses is split) and thin."""

    centre: Annotated[Tensor, "3"]
    radius: float

    @staticmethod
    def around(far: Points) -> "_Sphere":
        """The sphere of points."""
        centre = torch.from_numpy(far.position.mean(0)).float()
        return _Sphere(centre, float((torch.from_numpy(far.position).float() - centre).norm(dim=1).min()))

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
        if sphere is not None and step % 10 == 0:
            gaussians.limit_scales(sphere.widest(gaussians.read(MEANS)))
        if step % every:
            return
        wide = np.flatnonzero(gaussians.read(LOG_SCALES).max(1) > math.log(share * near))
        if len(wide):
            points = torch.from_numpy(gaussians.read(MEANS, wide))
            widest = torch.cat([share * nearest(part) for part in torch.split(points, _TOGETHER)]).clamp_min(1e-12).log()
            gaussians.limit_scales(widest.numpy(), wide)

    return narrow


def load_photographs(
    config: GaussiansConfig, scene: Scene, views: list[int]
) -> tuple[dict[int, Image], dict[int, NDArray[np.bool_]]]:
    """Images of views, and the masks of those that have one."""
    images = dict(zip(views, load_images(scene, config.background, views), strict=True))
    return images, _load_masks(scene.masks if config.masks else (), images)


def load_skies(config: GaussiansConfig, scene: Scene, images: Mapping[int, Image]) -> dict[int, NDArray[np.bool_]]:
    """The masks of the sky of the views that have one; none without surroundings: nothing else could show the sky."""
    return _load_masks(scene.sky_masks if config.masks and config.surroundings else (), images)


def _load_masks(paths: tuple[Path | None, ...], images: Mapping[int, Image]) -> dict[int, NDArray[np.bool_]]:
    """The masks of the views that have one, at the size of their images."""
    named = {view: paths[view] for view in images} if paths else {}
    return {view: load_mask(path, images[view].shape[1::-1]) for view, path in named.items() if path is not None}


def reach_of(scene: Scene) -> float:
    """Unit of the means' learning rate: the radius of the training cameras' positions.

    At most the distance at which views commonly see points, where the capture knows: steps in proportion to the radius of a
    district scatter what its views show.
    """
    around = scene.cameras.pose[scene.train][:, :, 3]
    reach = 1.1 * float((around - around.mean(0)).norm(dim=1).max()) or 1.0
    sightings = find_sightings(sparser(scene))
    return reach if sightings is None else min(reach, float(sightings.distance.median()))


def lit(facts: Facts, config: GaussiansConfig, scene: Scene, image: Callable[[int], Image]) -> Facts:
    """Facts with exposures and places of the views, where they are learnt; `image(view)` is a training view."""
    exposure = exposure_of(config.tones, scene, lambda view: torch.from_numpy(image(view)).float() / 255)
    if config.poses:
        centres = tuple((float(x), float(y), float(z)) for x, y, z in scene.cameras.pose[:, :, 3])
        facts = replace(facts, centres=centres, reach=sight_distance(scene, facts.space))
    return replace(facts, exposure=exposure, held=other_views(scene, scene.train.tolist()) if exposure or config.poses else ())


def other_views(scene: Scene, views: Iterable[int]) -> tuple[int, ...]:
    """Numbers of the views that are not among some."""
    return tuple(sorted(set(range(len(scene.paths))) - set(views)))


def poses_of(facts: Facts) -> Poses | None:
    """Poses as the capture says; None where they are not refined."""
    if not facts.centres:
        return None
    return Poses(torch.tensor(facts.centres, dtype=torch.float64), facts.held, reach=facts.reach, pace=1.0)


def facts_of(config: GaussiansConfig, scene: Scene) -> Facts:
    """Return the facts in scene.json of a scene without fields."""
    return Facts(
        space=find_space(scene),
        channels=0,
        dim=0,
        content_encoder="",
        semantic_encoder="",
        content_scale=1.0,
        semantic_scale=1.0,
        background=config.background,
        origin=scene.origin,
    )


def train(config: GaussiansConfig, prepared: Prepared, run: Run, report: Callable[[Report], None], *, spent: float) -> None:
    """Train, or go on from the newest checkpoint, until the steps or the minutes are over; `spent` seconds count as used.

    An interrupt saves first, then goes on upwards. A step whose loss is not finite changes nothing; raises NumericsError
    after several in a row.
    """
    learner, (first, last) = prepared.learner, prepared.shares
    checkpoint.tidy(run.checkpoints)
    saved, damaged = checkpoint.load_latest(run.checkpoints)
    for line in damaged:
        run.log({"damaged": line})
    step, clock = 0, spent
    if saved is not None:
        learner.restore(gaussians_of(saved), saved.optimizer)
        step, clock = saved.step, saved.seconds
    meter = _Meter(clock)
    last_saved = last_report = time.perf_counter()

    def save() -> None:
        state = state_of(learner.gaussians(), prepared.near)
        checkpoint.write(run.checkpoints, state, learner.moments(), step=step, seconds=clock)

    with held_back() as stop:
        try:
            while (share := progress(config, step, clock)) < 1:
                stop.obey()
                measured = learner.step(prepared.before + step, first + (last - first) * share)
                step += 1
                meter.add(measured)
                if measured is None:
                    run.log({"step": step - 1, "skipped": "loss"})
                if meter.failed >= _PATIENCE:
                    raise NumericsError(f"step {step}: the loss is not finite for {_PATIENCE} steps in a row; lower --rate")
                now = time.perf_counter()
                clock = meter.clock(now)
                if now - last_report > REPORT_SECONDS:
                    last_report = now
                    report(meter.report(step, progress(config, step, clock), clock))
                if now - last_saved > 60 * config.checkpoint_minutes:
                    save()
                    last_saved = time.perf_counter()
            stop.obey()
        except KeyboardInterrupt:
            if not stop.hurried:
                save()
            raise
    if saved is None or step > saved.step:
        save()
        report(meter.report(step, 1.0, clock))


class _Meter:
    """Running means of training for the display."""

    def __init__(self, before: float) -> None:
        self.before, self.begun = before, time.perf_counter()
        self.skipped = self.failed = self.pixels = 0
        self.means: dict[str, float] = {}

    def clock(self, now: float) -> float:
        """Seconds of training, those of earlier starts included."""
        return self.before + now - self.begun

    def add(self, step: Step | None) -> None:
        """Count a step."""
        if step is None:
            self.skipped, self.failed = self.skipped + 1, self.failed + 1
            return
        self.failed = 0
        self.pixels += step.pixels
        for name, value in (("rgb", step.squared), ("l1", step.l1), ("ssim", step.ssim)):
            self.means[name] = _SMOOTHING * self.means.get(name, value) + (1 - _SMOOTHING) * value
        self.means["gaussians"] = float(step.gaussians)

    def report(self, step: int, share: float, seconds: float) -> Report:
        """Return the progress."""
        rgb = max(self.means.get("rgb", 1.0), 1e-10)
        speed = self.pixels / max(time.perf_counter() - self.begun, 1e-9)
        return Report(step, share, seconds, -10 * math.log10(rgb), speed, 1.0, dict(self.means), self.skipped)


def state_of(gaussians: Gaussians, near: float) -> dict[str, Tensor]:
    """The tensors of a checkpoint; nothing nearer to a camera than `near` is drawn."""
    return vars(gaussians) | {"near": torch.tensor(near, dtype=torch.float64)}


def gaussians_of(saved: checkpoint.Saved) -> Gaussians:
    """The Gaussians of a checkpoint. Raises CheckpointError where it holds none."""
    try:
        return _gaussians(saved.model)
    except KeyError as error:
        raise CheckpointError(f"checkpoint of step {saved.step}: holds no {error}, so it is not of Gaussians") from error


def _gaussians(tensors: Mapping[str, Tensor]) -> Gaussians:
    return Gaussians(**{field.name: tensors[field.name] for field in fields(Gaussians)})


def open_gaussians(root: Path, config: GaussiansConfig, quality: QualityConfig) -> LoadedRun[SplatScene]:
    """A run's Gaussians from its folder alone; `config` is its own.

    Raises CheckpointError with what is missing, UsageError for qualities other than a resolution.
    """
    for name in ("samples", "budget", "chunk", "max_memory"):
        if getattr(quality, name):
            raise UsageError(f"--{name.replace('_', '-')}: is for runs of fields; leave it out")
    run = Run(root)
    preset = None if quality.quality is None else PRESETS[quality.quality]
    merged = None if preset is None else preset.merged
    # Levels of detail were written from what was verified.
    key = "" if merged is None else checkpoint.digest(run.checkpoints)
    saved, _ = checkpoint.load_latest(run.checkpoints, verify=not key or open_levels(root / _LEVELS, key) is None)
    if saved is None:
        raise CheckpointError(f"{root}: no checkpoint yet; go on with `fprf train {root / 'config.json'} --output {root}`")
    known, gaussians = run.load_known(), gaussians_of(saved)
    known = replace(known, cameras=refined(known.cameras, saved))
    near = float(saved.model.get("near", torch.tensor(0.01)))
    resolution = preset.resolution if preset is not None else 1.0
    encoder = cache(config.semantic.encoder.build)
    scene = SplatScene(
        gaussians,
        True,
        known.cameras,
        known.names,
        cache(lambda: _semantics(run, saved.step, known, gaussians, near, encoder(), config)),
        encoder,
        min(config.semantic_size, int(known.cameras.size.amax())),
        near,
        config.background,
        resolution if quality.resolution is None else quality.resolution,
        tone=mixed_tone(_tones(saved, known.facts), known, quality.tone) if quality.tone else (1.0, 1.0, 1.0),
        merged=merged,
        levels=cache(lambda: _levels(root / _LEVELS, gaussians, key)),
        origin=known.facts.origin,
    )
    return LoadedRun(run, run.load_config()[1], known, saved.step, saved.seconds, scene)


def _some_views(known: Known, count: int, longest: int) -> Cameras:
    """Training views, spread evenly, at most `count` of at most so many pixels a side."""
    every = torch.tensor(known.train)
    views = known.cameras.select(every[torch.linspace(0, len(every) - 1, min(count, len(every))).round().long()])
    return views.scaled(max(1.0, float(views.size.amax()) / longest))


def _levels(folder: Path, gaussians: Gaussians, key: str) -> Levels:
    """Levels of detail of a run; those of many Gaussians lie in a file, written where there is none of its checkpoint."""
    if len(gaussians) < _MANY:
        return make_levels_of_detail(gaussians)
    levels = open_levels(folder, key)
    if levels is None:
        write_levels(folder, gaussians, key)
        levels = open_levels(folder, key)
    assert levels is not None  # it was just written
    return levels


def refined(cameras: Cameras, saved: checkpoint.Saved) -> Cameras:
    """The cameras of all views where training put them."""
    moves = saved.optimizer.get(MOVES)
    return cameras if moves is None else moved_cameras(cameras, moves)


def fit_poses(
    config: GaussiansConfig, scene: Scene, opened: LoadedRun[SplatScene], views: list[int]
) -> Annotated[Tensor, "V 6"]:
    """Turns (radians) and shifts (world units), float64, that bring renders of some views nearest to their photographs.

    Gaussians stay as they are; the other views' moves are 0.
    """
    cameras, facts, shown = opened.known.cameras, opened.known.facts, opened.scene
    scene = replace(scene, cameras=cameras, train=torch.tensor(views))
    images, masks = load_photographs(config, scene, views)
    poses = Poses(
        cameras.pose[:, :, 3], other_views(scene, views), reach=sight_distance(scene, facts.space), pace=1.0, still=True
    )
    levels, tones = make_levels(scene, images, masks, shown.near), load_tones(opened.run)
    config = replace(config, poses=_FIT_RATE, degree=shown.gaussians.degree)
    learner = Learner(config, levels, 1.0, len(shown.gaussians), tones=tones, poses=poses, only="poses")
    learner.start_from(shown.gaussians)
    steps = _FIT_STEPS * len(views)
    for step in range(steps):
        learner.step(step, step / steps)
    return poses.moved_by()


def load_tones(run: Run) -> Tones | None:
    """Return the exposure of each view of a run; None where that was not learnt."""
    saved, _ = checkpoint.load_latest(run.checkpoints)
    return None if saved is None else _tones(saved, run.load_known().facts)


def _tones(saved: checkpoint.Saved, facts: Facts) -> Tones | None:
    tones = tones_of(facts)
    if tones is not None:
        tones.load_state_dict(
            {name: saved.optimizer[f"tones.{name}.value"] for name, _ in tones.named_parameters()}, strict=False
        )
        tones.requires_grad_(False)
    return tones


def _semantics(
    run: Run, step: int, known: Known, gaussians: Gaussians, near: float, encoder: Encoder, config: GaussiansConfig
) -> Semantics:
    """Return the semantics, from the run folder; found anew and kept where those are of another step, encoder or setting."""
    wanted = {"step": step, "regions": config.regions, "semantic_size": config.semantic_size}
    if (run.root / "style.safetensors").is_file():
        tensors = run.load_tensors("style")
        if {name: int(tensors.pop(name, torch.tensor(-1))) for name in wanted} == wanted:
            kept = load_semantics(tensors, len(gaussians))
            if kept.encoder == encoder.identity:
                return kept
    views = _some_views(known, _VIEWS, config.semantic_size)
    semantics = find_semantics(gaussians, True, encoder, views, config.regions, near=near)
    run.save_tensors("style", {**semantics_tensors(semantics), **{name: torch.tensor(of) for name, of in wanted.items()}})
    return semantics


def find_near(scene: Scene, points: Points) -> float:
    """Distance from cameras, along z, from which on things are drawn."""
    some = torch.from_numpy(points.position[:: -(-len(points.position) // _SOME)])
    seen = torch.cat([depth[inside] for _, _, depth, inside in projected(scene, some)])
    if not len(seen):
        return _NEAR_UNSEEN * reach_of(scene)
    return _NEAR * float(seen[:: -(-len(seen) // _DEPTHS)].quantile(0.01))
