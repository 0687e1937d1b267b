"""Before the first step: parse the scene, find its space, extract features."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..config import RunConfig, TrainConfig
from ..datamanagers.basis import Basis
from ..datamanagers.bounds import find_space
from ..datamanagers.images import WHITE
from ..datamanagers.parsers.config import parse_scene
from ..datamanagers.scene import ParsedScene, at_origin, exposures_differ, find_sightings, with_exposure
from ..errors import PluginError, UsageError, WeightsError
from ..interfaces import DataManager, Encoder
from ..rendering.space import Space
from .model import Facts, build_decoder


class Prepared(NamedTuple):
    """A scene that is ready to be trained."""

    scene: ParsedScene
    manager: DataManager
    facts: Facts
    basis: Basis | None
    """Semantic basis; None without semantics."""


def cache_folder() -> Path:
    """Folder of features and embedded scenes between runs: $XDG_CACHE_HOME/fprf or ~/.cache/fprf."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fprf"


def device_of(name: str) -> torch.device:
    """`auto` is CUDA, then MPS, then the CPU. Raises PluginError for a device that torch does not know
    here.
    """
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda", torch.cuda.current_device())
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as e:
        known = ", ".join(["auto", "cpu", *(f"cuda:{k}" for k in range(torch.cuda.device_count()))])
        if name.startswith("cuda:"):
            ray = "; a worker of Ray counts the GPUs that it was given from 0: take cuda"
        else:
            ray = ""
        raise PluginError(f"device: {name!r} is not available here; there is {known}{ray}") from e


def planned(config: RunConfig, whole: ParsedScene | None = None) -> RunConfig:
    """The config with what it leaves open decided, the size of its images first, by its scene at its own
    size.

    That is read where it is not given. Raises as `read_scene`.
    """
    if all(getattr(config, name) is not None for name in config.open):
        return config
    return config.planned(whole or read_scene(replace(config, downscale=1)), device_of(config.trained_on))


def read_scene(config: RunConfig, saved: Facts | None = None) -> ParsedScene:
    """The scene of a config, at its size, about the origin of a run that goes on (`saved`).

    Raises UsageError where it names none, DataError where that cannot be read.
    """
    if config.data is None:
        raise UsageError("no scene is named: give --data FOLDER, or --data garden for the embedded one")
    scene = parse_scene(config.data, config.downscale or 1, config.scene_parser)
    if config.downscale is None and (size := planned(config, scene).downscale or 1) != 1:
        scene = replace(scene, cameras=scene.cameras.scaled(size))
    return scene if saved is None else at_origin(scene, saved.origin)


def build_encoders(config: TrainConfig, *, semantic: bool = True) -> tuple[Encoder, Encoder | None]:
    """The encoders of content and, where wanted and chosen, of semantics. Raises WeightsError with what
    either lacks.
    """
    built = list[Encoder | None]()
    missing = list[str]()
    for each in (config.content.encoder, config.semantic.encoder if semantic else None):
        try:
            built.append(None if each is None else each.build())
        except WeightsError as error:
            missing.append(str(error))
    if missing:
        raise WeightsError("; also ".join(missing))
    content, other = built
    assert content is not None
    return content, other


def prepare(
    config: TrainConfig,
    scene: ParsedScene,
    saved: Facts | None = None,
    progress: Callable[[int, int, str], None] | None = None,
    *,
    space: Space | None = None,
    basis: Basis | None = None,
    seen: Callable[[int], Annotated[Tensor, "H W"]] | None = None,
) -> Prepared:
    """Everything of a scene of fields but the model, in a space that is found where none is given.

    Arguments as of `RunConfig.build` and `DataManagerConfig.build`. Raises WeightsError where an encoder or a
    decoder lacks its weights.
    """
    device = device_of(config.device)
    content, semantic = build_encoders(config)
    content = content.to(device)
    semantic = None if semantic is None else semantic.to(device)
    build_decoder(
        config, encoder=content.identity, channels=content.channels
    )  # refused now, not after all the features
    background = config.render.background or (WHITE if scene.alpha else None)
    # Decodes all images and extracts their features, or finds both in the cache.
    manager = config.datamanager.build(
        scene=scene,
        content=content,
        semantic=semantic,
        dim=config.semantic.dim,
        cache=cache_folder() / "features",
        seed=config.seed,
        progress=progress,
        basis=basis,
        seen=seen,
        background=background,
    )
    exposure = exposure_of(config.tones, scene, manager.image, saved)
    facts = facts_of(scene, background, space=space, exposure=exposure, poses=config.poses > 0)
    # Scales are the spread of the targets: losses in their units weigh the same with any encoder.
    contents = manager.content_store
    semantics = manager.semantic_store
    facts = replace(
        facts,
        channels=content.channels,
        dim=0 if semantics is None else semantics.channels,
        content_encoder=content.identity,
        semantic_encoder="" if semantic is None else semantic.identity,
        content_scale=1.0 if contents is None else contents.scale,
        semantic_scale=1.0 if semantics is None else semantics.scale,
    )
    return Prepared(scene, manager, facts, None if semantics is None else semantics.basis)


def facts_of(
    scene: ParsedScene,
    background: tuple[float, float, float] | None = None,
    *,
    space: Space | None = None,
    exposure: tuple[float, ...] = (),
    poses: bool = False,
) -> Facts:
    """Facts of a scene without fields; `space` is found where none is given, `poses` says whether cameras are
    refined.
    """
    space = find_space(scene) if space is None else space
    # Corrections of views that nothing is learnt from stay at none.
    others = tuple(sorted(set(range(len(scene.paths))) - set(scene.train.tolist())))
    return Facts(
        space=space,
        background=background,
        exposure=exposure,
        held=others if exposure or poses else (),
        centres=tuple((float(x), float(y), float(z)) for x, y, z in scene.cameras.pose[:, :, 3])
        if poses
        else (),
        reach=reach_of(scene, space) if poses else 1.0,
        origin=scene.origin,
    )


def exposure_of(
    tones: bool | None,
    scene: ParsedScene,
    image: Callable[[int], Annotated[Tensor, "H W 3"]],
    saved: Facts | None = None,
) -> tuple[float, ...]:
    """Logarithm of each view's exposure over their geometric mean; empty where tones are not learnt.

    `tones` None = learn them where exposures differ. `image(view)` is a training view, in [0, 1].
    """
    # A run goes on with what was measured when it was begun: gains were learnt relative to that.
    if saved is not None:
        return saved.exposure
    if tones is False:
        return ()
    exposure = with_exposure(scene, image).exposure
    if not tones and not exposures_differ(exposure):
        return ()
    if exposure is None:  # learnt from nothing: all are taken as alike
        return (0.0,) * len(scene.paths)
    log = exposure.double().log()
    return tuple((log - log.mean()).tolist())


def reach_of(scene: ParsedScene, space: Space) -> float:
    """World distance that training views commonly see: of their sparse points, else a unit of the space."""
    sightings = find_sightings(scene)
    if sightings is not None:
        return float(sightings.distance.median())
    return space.near if space.kind == "ndc" else 1 / space.scale
