"""Before the first step: parse the scene, find its space, extract features."""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from ..datamanagers.bounds import find_space
from ..datamanagers.parsers.config import parse_scene
from ..datamanagers.scene import ParsedScene, at_origin, exposures_differ, find_sightings, with_exposure
from ..errors import PluginError, UsageError
from ..rendering.space import Space
from ..run_config import RunConfig
from .facts import Facts


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
    return config.planned(whole or read_whole_scene(config), device_of(config.reading.device))


def read_scene(config: RunConfig, saved: Facts | None = None) -> ParsedScene:
    """The scene of a config, at its size, about the origin of a run that goes on (`saved`).

    Raises UsageError where it names none, DataError where that cannot be read.
    """
    whole = read_whole_scene(config)
    if config.downscale is None:
        sized = planned(config, whole)
    else:
        sized = config
    return scene_at_size(sized, whole, saved)


def read_whole_scene(config: RunConfig) -> ParsedScene:
    """The scene of a config at its own size. Raises as `read_scene`."""
    if config.data is None:
        raise UsageError("no scene is named: give --data FOLDER, or --data garden for the embedded one")
    return parse_scene(config.data, 1, config.reading.parser, config.up)


def scene_at_size(config: RunConfig, whole: ParsedScene, saved: Facts | None = None) -> ParsedScene:
    """A scene that was read at its own size, at that of a planned config, about the origin of a run that goes on."""
    whole = config.calibrated(whole)
    size = config.downscale or 1
    if size == 1:
        scene = whole
    else:
        scene = replace(whole, cameras=whole.cameras.scaled(size))
    if saved is None:
        return scene
    return at_origin(scene, saved.origin)


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
        up=scene.up,
        north=scene.north,
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
