"""Feed-forward photorealistic style transfer of large-scale 3D radiance fields."""

import os
from collections.abc import Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Literal

from .errors import Stopped

if TYPE_CHECKING:
    from pathlib import Path

    from .api import FinishedCapture, TrainedScene
    from .progress import Listener
    from .reconstruction.config import SfmConfig
    from .run_config import RunConfig

__version__ = version("fprf")
__all__ = ["Stopped", "__version__", "load", "process", "read", "train"]


def process(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    *,
    settings: "SfmConfig | None" = None,
    progress: "Listener | None" = None,
) -> "Path":
    """Camera poses for a folder of images or a video, as by `fprf process`. Returns the scene folder, by default
    scenes/NAME; what became of every image stands in its process.json.

    `settings` are the flags of the command. `progress` is called with each change, in the place of what is shown
    otherwise, and may raise `fprf.Stopped`; the same call goes on from there. Raises UsageError where the source or
    pycolmap is missing, DataError where no poses are found.
    """
    from .io.paths import as_path
    from .progress import Display
    from .reconstruction.config import SfmConfig
    from .reconstruction.process import process as reconstruct

    with Display(quiet=progress is not None, listener=progress) as display:
        place = None if output is None else as_path(output)
        root, _ = reconstruct(as_path(source), place, settings or SfmConfig(), display)
    return root


def train(
    data: str | os.PathLike[str],
    method: str = "fprf-splats",
    *,
    output: str | os.PathLike[str] | None = None,
    minutes: float | None = None,
    device: str = "auto",
    config: "RunConfig | None" = None,
    progress: "Listener | None" = None,
) -> "TrainedScene":
    """Train a scene folder by an installed method and open the run, by default runs/SCENE-METHOD. A run that is there
    already goes on.

    `config` is one that the method gave, with fields replaced; `minutes` and `device` come over it. `progress` is
    called with each change, in the place of what is shown otherwise; where it raises `fprf.Stopped`, or the kernel is
    interrupted, the run is saved, and the same call goes on with it. Raises UsageError where something is missing,
    DataError for a scene that cannot be read.
    """
    from dataclasses import replace

    from .config_files import method_config
    from .io.paths import as_path
    from .plugins import slots
    from .training.driver import default_output
    from .training.driver import train as train_run
    from .training.run import make_room

    scene = as_path(data)
    chosen = replace(config or method_config(method), data=scene)
    place = default_output(chosen, method) if output is None else as_path(output)
    chosen = replace(chosen, output=place)
    if minutes is not None:
        chosen = replace(chosen, minutes=minutes)
    if device != "auto":
        chosen = slots.replace(chosen, "device", device)
    make_room(place, [scene], overwrite=False)
    run = train_run(chosen, method, quiet=progress is not None, listener=progress)
    return load(run, device=device)


def load(
    run: str | os.PathLike[str],
    *,
    device: str = "auto",
    quality: Literal["draft", "standard", "best"] | None = None,
) -> "TrainedScene":
    """A trained run, ready to restyle and render; needs neither its images nor, before `stylize`, its
    encoders.

    `device` is cpu, cuda, mps or auto; `quality` trades time for error as in `fprf render`. Raises
    CheckpointError where `run` is no run folder or holds no checkpoint.
    """
    # torch is imported when a scene is
    from functools import cache

    from .api import TrainedScene
    from .io.paths import as_path
    from .training.loading import open_run
    from .training.quality import QualityConfig

    trained = open_run(as_path(run), device, QualityConfig(quality=quality))
    return TrainedScene(trained, encoders=cache(trained.scene.encoders))


def read(
    path: str | os.PathLike[str],
    *,
    views: int = 32,
    up: Sequence[float] | None = None,
    north: Sequence[float] | None = None,
    inside: bool | None = None,
    activated: bool = False,
) -> "FinishedCapture":
    """A finished capture of 3D Gaussians, ready to restyle and write: a file of any format that is installed.

    `views`, `up`, `north` and `inside` are those of `fprf restyle`: how it is looked at. `activated` reads numbers that
    look activated already as such; `capture.notes` of what is returned says where they do. Raises DataError
    where it cannot be read.
    """
    from .api import FinishedCapture
    from .io.paths import as_path
    from .plugins.conversion import three_numbers
    from .splats.captures import with_asked_north
    from .splats.config import LookConfig
    from .splats.files import read_capture

    direction = None if up is None else three_numbers("up", up)
    there = None if north is None else three_numbers("north", north)
    look = LookConfig(views=views, up=direction, north=there, inside=inside, activated=activated)
    capture = read_capture(as_path(path), activated=activated)
    return FinishedCapture(with_asked_north(capture, look), look)
