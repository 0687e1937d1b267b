"""Before the first step: parse the scene, find its space, extract features, build the model."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.batches import WHITE
from ..datamanagers.bounds import find_space
from ..datamanagers.features import FeatureStore
from ..datamanagers.parsers.config import parse_scene
from ..datamanagers.scene import Scene, exposures_differ, find_sightings, with_exposure
from ..errors import PluginError, UsageError, WeightsError
from ..interfaces import DataManager, Encoder
from ..rendering.space import Space
from .budget import find_downscale
from .decoder import build_decoder
from .model import Facts
from .tones import relative

__all__ = [
    "Prepared",
    "behind",
    "build_encoders",
    "cache_folder",
    "device_of",
    "exposure_of",
    "facts_of",
    "prepare",
    "reach_of",
    "scene_of",
    "with_downscale",
]


class Prepared(NamedTuple):
    """A scene that is ready to be trained."""

    scene: Scene
    manager: DataManager
    facts: Facts
    basis: Basis | None
    """Semantic basis; None without semantics."""


def cache_folder() -> Path:
    """Where features and embedded scenes are kept between runs: $XDG_CACHE_HOME/fprf or ~/.cache/fprf."""
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
        raise PluginError(f"device: {name!r} is not available here; use cpu or auto") from e


def with_downscale(config: TrainConfig) -> TrainConfig:
    """The config with the size of its images decided: unchanged where `downscale` is a number. Raises as `scene_of`."""
    if config.downscale is not None:
        return config
    delivered = scene_of(replace(config, downscale=1))
    sizes = delivered.cameras.size[delivered.train]
    return replace(config, downscale=find_downscale(config, sizes, device_of(config.device).type) if len(sizes) else 1)


def scene_of(config: TrainConfig) -> Scene:
    """The scene of a config, at its size. Raises UsageError where it names none, DataError where that cannot be read."""
    if config.data is None:
        raise UsageError("no scene is named: give --data FOLDER, or --data town for the embedded one")
    size = with_downscale(config).downscale
    return parse_scene(config.data, size or 1, config.datamanager.parser)


def prepare(
    config: TrainConfig,
    progress: Callable[[int, int, str], None] | None = None,
    look: Callable[[Scene], None] = lambda scene: None,
    saved: Facts | None = None,
) -> Prepared:
    """Everything but the model. `progress(done, total, what)` is told of the features; `look` may refuse the scene before.

    `saved` are the facts of a run that goes on: its exposures are not measured again.
    """
    scene = scene_of(config)
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
    exposure = exposure_of(config, scene, manager.image, saved)
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
    """What was found out about a scene."""
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
    )


def exposure_of(
    config: TrainConfig, scene: Scene, image: Callable[[int], Annotated[Tensor, "H W 3"]], saved: Facts | None = None
) -> tuple[float, ...]:
    """`relative` exposure of the views; empty where tones are not learnt. `image(view)` is a training view, in [0, 1]."""
    if saved is not None:
        return saved.exposure
    if config.tones is False:
        return ()
    exposure = with_exposure(scene, image).exposure
    return relative(exposure, len(scene.paths)) if config.tones or exposures_differ(exposure) else ()


def reach_of(scene: Scene, space: Space) -> float:
    """World distance that training views commonly see: of their sparse points, else a unit of the space."""
    sightings = find_sightings(scene)
    if sightings is not None:
        return float(sightings.distance.median())
    return space.near if space.kind == "ndc" else 1 / space.scale


def behind(config: TrainConfig, scene: Scene) -> tuple[float, float, float] | None:
    """Colour behind everything: images and renders show the same. None where nothing is assumed."""
    return config.render.background or (WHITE if scene.alpha else None)
