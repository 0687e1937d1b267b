"""Before the first step: parse the scene, find its space, extract features, build the model."""

import math
import os
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import RunConfig, TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.bounds import find_space
from ..datamanagers.features import FeatureStore
from ..datamanagers.images import WHITE
from ..datamanagers.parsers.config import parse_scene, recognise
from ..datamanagers.scene import Scene, at_origin, exposures_differ, find_sightings, with_exposure
from ..errors import CheckpointError, DataError, PluginError, UsageError, WeightsError
from ..interfaces import DataManager, Encoder
from ..plugins.config import Need
from ..plugins.decoders.config import pretrain_line
from ..plugins.slots import slots
from ..rendering.space import Space
from .camera_optimizers import relative
from .model import Facts, build_decoder
from .run import read_history

if TYPE_CHECKING:
    from .trainer import Report


class Prepared(NamedTuple):
    """A scene that is ready to be trained."""

    scene: Scene
    manager: DataManager
    facts: Facts
    basis: Basis | None
    """Semantic basis; None without semantics."""


def cache_folder() -> Path:
    """Folder of features and embedded scenes between runs: $XDG_CACHE_HOME/fprf or ~/.cache/fprf."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fprf"


def device_of(name: str) -> torch.device:
    """`auto` is CUDA, then MPS, then the CPU. Raises PluginError for a device that torch does not know here."""
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda", torch.cuda.current_device())
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as e:
        known = ", ".join(["auto", "cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))])
        ray = "; a worker of Ray counts the GPUs that it was given from 0: take cuda" if name.startswith("cuda:") else ""
        raise PluginError(f"device: {name!r} is not available here; there is {known}{ray}") from e


def with_downscale(config: TrainConfig) -> TrainConfig:
    """The config with the size of its images decided: unchanged where `downscale` is a number. Raises as `scene_of`."""
    if config.downscale is not None:
        return config
    delivered = scene_of(replace(config, downscale=1))
    sizes = delivered.cameras.size[delivered.train]
    return replace(config, downscale=find_downscale(config, sizes, device_of(config.device).type) if len(sizes) else 1)


def scene_of(config: TrainConfig, saved: Facts | None = None) -> Scene:
    """The scene of a config, at its size, about the origin of a run that goes on (`saved`).

    Raises UsageError where it names none, DataError where that cannot be read.
    """
    if config.data is None:
        raise UsageError("no scene is named: give --data FOLDER, or --data garden for the embedded one")
    size = with_downscale(config).downscale
    scene = parse_scene(config.data, size or 1, config.datamanager.parser)
    return scene if saved is None else at_origin(scene, saved.origin)


def prepare(
    config: TrainConfig,
    progress: Callable[[int, int, str], None] | None = None,
    look: Callable[[Scene], None] = lambda scene: None,
    saved: Facts | None = None,
) -> Prepared:
    """Everything but the model. `progress(done, total, what)` is told of the features; `look` may refuse the scene before.

    `saved` are the facts of a run that goes on: its exposures are not measured again, and its origin stays.
    """
    scene = scene_of(config, saved)
    look(scene)
    content, semantic = build_encoders(config)
    build_decoder(config, encoder=content.identity, channels=content.channels)  # refused now, not after all the features
    manager = config.datamanager.build(
        scene=scene,
        content=content,
        semantic=semantic,
        dim=config.semantic.dim,
        cache=cache_folder() / "features",
        seed=config.seed,
        progress=progress,
        background=behind(config, scene),
    )
    semantic_store = manager.semantic_store
    exposure = exposure_of(config.tones, scene, manager.image, saved)
    facts = facts_of(config, scene, find_space(scene), exposure, content, semantic, manager.content_store, semantic_store)
    return Prepared(scene, manager, facts, semantic_store.basis if semantic_store is not None else None)


def build_encoders(config: TrainConfig) -> tuple[Encoder, Encoder | None]:
    """The content encoder and the semantic one, if there is one, on the device of the config.

    Raises WeightsError with what both of them lack.
    """
    device = device_of(config.device)
    built: list[Encoder | None] = []
    faults: list[WeightsError] = []
    for encoder in (config.content.encoder, config.semantic.encoder):
        try:
            built.append(None if encoder is None else encoder.build().to(device))
        except WeightsError as fault:
            faults.append(fault)
    if len(faults) > 1:
        raise WeightsError("; ".join(map(str, faults))) from faults[0]
    if faults:
        raise faults[0]
    content, semantic = built
    assert content is not None
    return content, semantic


def facts_of(
    config: TrainConfig,
    scene: Scene,
    space: Space,
    exposure: tuple[float, ...],
    content: Encoder,
    semantic: Encoder | None,
    content_store: FeatureStore | None,
    semantic_store: FeatureStore | None,
) -> Facts:
    """Facts of a scene."""
    return Facts(
        space=space,
        channels=content.channels,
        dim=semantic_store.channels if semantic_store is not None else 0,
        content_encoder=content.identity,
        semantic_encoder=semantic.identity if semantic is not None else "",
        content_scale=content_store.scale if content_store is not None else 1.0,
        semantic_scale=semantic_store.scale if semantic_store is not None else 1.0,
        background=behind(config, scene),
        exposure=exposure,
        held=tuple(sorted(set(range(len(scene.paths))) - set(scene.train.tolist()))) if exposure or config.poses else (),
        centres=tuple((float(x), float(y), float(z)) for x, y, z in scene.cameras.pose[:, :, 3]) if config.poses else (),
        reach=reach_of(scene, space) if config.poses else 1.0,
        origin=scene.origin,
    )


def exposure_of(
    tones: bool | None, scene: Scene, image: Callable[[int], Annotated[Tensor, "H W 3"]], saved: Facts | None = None
) -> tuple[float, ...]:
    """`relative` exposure of the views; empty where tones are not learnt: None = where exposures differ.

    `image(view)` is a training view, in [0, 1].
    """
    if saved is not None:
        return saved.exposure
    if tones is False:
        return ()
    exposure = with_exposure(scene, image).exposure
    return relative(exposure, len(scene.paths)) if tones or exposures_differ(exposure) else ()


def reach_of(scene: Scene, space: Space) -> float:
    """World distance that training views commonly see: of their sparse points, else a unit of the space."""
    sightings = find_sightings(scene)
    if sightings is not None:
        return float(sightings.distance.median())
    return space.near if space.kind == "ndc" else 1 / space.scale


def behind(config: TrainConfig, scene: Scene) -> tuple[float, float, float] | None:
    """Colour behind everything: images and renders show the same. None where nothing is assumed."""
    return config.render.background or (WHITE if scene.alpha else None)


class _Pace(NamedTuple):
    """Speed of a kind of device, within a factor of two."""

    rays: float
    """Rays trained in a second by `fprf-lite`."""
    features: float
    """Seconds that the features of a million pixels take."""
    least: float
    """Pixels of an image that are trained on however few rays there are."""


_CPU = _Pace(rays=20e3, features=4.0, least=0.2e6)
_ACCELERATOR = _Pace(rays=1e6, features=0.2, least=1e6)
_PASSES = 4
"""Rays that larger images must leave for each of their pixels."""
_FEATURE_SHARE = 0.5
"""Share of a time limit that features may take before images are reduced below `least`, to a quarter of it at most."""
_LONG_HOURS = 1.0
"""Trainings without a time limit that take longer say so."""
_TIMED_SECONDS = 5.0
"""Time over which the first steps are measured."""
_FEW_STEPS = 600
"""Fewer are too few to judge by: a garden of ten views shows streaks on held-out ones after 350, at 19.8 dB on the training
views; flower and fox are at 22.9 and 27.1 dB on held-out views after 754 and 775."""


def find_downscale(config: TrainConfig, sizes: Annotated[Tensor, "T 2"], device: str) -> int:
    """The factor by which training images of these sizes (width, height) are reduced, at least 1.

    `device` is a kind of device: cpu, cuda, mps. The size of an image is found from their mean, as the square root of their
    pixels over those wanted, rounded to a whole factor: images up to 2.25 times as large as wanted stay as they are.
    """
    pace = _CPU if device == "cpu" else _ACCELERATOR
    rays = float(config.steps * config.datamanager.batch_rays())
    if config.minutes is not None:
        rays = min(rays, 60 * config.minutes * pace.rays)
    wanted = max(pace.least, rays / _PASSES / len(sizes))
    if config.minutes is not None:
        encoded = 1e6 * _FEATURE_SHARE * 60 * config.minutes / pace.features / len(sizes)
        wanted = min(wanted, max(encoded, pace.least / 4))
    pixels = float(sizes.double().prod(1).mean())
    return max(1, round(math.sqrt(pixels / wanted)))


class Forecast:
    """Tells from the first steps of a training, once, that all of them will take hours on a CPU."""

    def __init__(self, config: TrainConfig, method: str, device: str) -> None:
        self.config, self.method = config, method
        self._first: Report | None = None
        self._told = device != "cpu" or config.minutes is not None

    def __call__(self, event: "Report") -> str:
        """A line to show, or nothing."""
        if self._told:
            return ""
        first = self._first = self._first or event  # whose time holds the compilation of kernels
        steps, seconds = event.step - first.step, event.seconds - first.seconds
        if steps < 1 or seconds < _TIMED_SECONDS:
            return ""
        self._told = True
        hours = (self.config.steps - event.step) * seconds / steps / 3600
        if hours < _LONG_HOURS:
            return ""
        other = "" if self.method == "fprf-lite" else "; the method fprf-lite is made for a CPU and needs 8"
        return (
            f"{self.config.steps:,} steps at {seconds / steps:.2g} s a step take {hours:,.0f} hours on this CPU; "
            f"--minutes N fits steps and learning rate into N minutes{other}"
        )


class Outcome(NamedTuple):
    """Outcome of a training."""

    steps: int
    """Of the block that was trained least, where there are several."""
    psnr: float
    """Of the training rays in dB, smoothed; the mean over blocks."""
    passes: float
    """Rays drawn for each pixel of the training views."""

    @property
    def too_short(self) -> bool:
        """True where training was too short to be judged."""
        return self.steps < _FEW_STEPS

    def told(self, root: Path, config: TrainConfig) -> str:
        """One line: what the run in a folder reached, and the command that would raise it."""
        reached = f"{self.steps:,} steps, {self.passes:.2g} rays for each pixel, {self.psnr:.1f} dB on the training views"
        timed = config.minutes is not None and self.steps < config.steps
        again = f"fprf train {shlex.quote(str(root / 'config.json'))}"
        longer = f"--minutes {2 * (config.minutes or 0):g}" if timed else f"--steps {max(2 * config.steps, _FEW_STEPS)}"
        if self.too_short:
            return f"warning: too few steps to judge the scene by: {reached}; go on: {again} {longer}"
        size = config.downscale or 1
        finer = f"; for more detail: --downscale {size - 1} and another --output" if size > 1 and self.passes > _PASSES else ""
        return f"{reached}; to raise it: {again} {longer}{finer}"


def outcome(root: Path, config: TrainConfig, scene: Scene) -> Outcome | None:
    """Outcome by a run's events.jsonl, or those of its blocks; None where no step was made."""
    try:
        trained = [history for history in read_history(root) if history.values.get("psnr", [None])[-1] is not None]
    except CheckpointError:
        return None
    blocks = [history for history in trained if history.name] or trained
    if not blocks:
        return None
    steps = sum(history.step[-1] for history in trained)
    pixels = int(scene.cameras.size[scene.train].prod(1).sum())
    psnr = [history.values["psnr"][-1] or 0.0 for history in blocks]
    rays = steps * config.datamanager.batch_rays()
    return Outcome(min(history.step[-1] for history in blocks), sum(psnr) / len(psnr), rays / pixels)


def plugin_needs(config: RunConfig) -> list[Need]:
    """The needs of all plug-ins of a config, each opened by the path of its slot.

    Raises PluginError where a plug-in cannot say what it needs.
    """
    missing = []
    for slot in slots(config):
        try:
            needs = () if slot.value is None else tuple(slot.value.needs())
        except Exception as error:  # a stranger's
            raise PluginError(f"{slot.path}: cannot say what it needs ({type(error).__name__}: {error})") from error
        missing += [need._replace(what=f"{slot.path}: {need.what}") for need in needs]
    return missing


def decoder_needs(config: TrainConfig) -> list[Need]:
    """A decoder for the content encoder; its weights are read, so ask where the encoder itself lacks nothing."""
    try:
        encoder = config.content.encoder.build()
        config.content.decoder.build(encoder=encoder.identity, channels=encoder.channels, seed=config.seed)
    except WeightsError as fault:
        return [Need(f"content.decoder: {fault}", pretrain_line(config.content.encoder))]
    return []


def scene_needs(config: TrainConfig) -> list[Need]:
    """A scene folder that some parser reads."""
    if config.data is None:
        return [Need("no scene is named", "give --data FOLDER, or --data garden for the embedded scene")]
    if config.datamanager.parser is not None:
        return []
    try:
        recognise(config.data)
    except DataError as fault:
        return [Need("the scene", str(fault))]
    return []
