"""Feed-forward photorealistic style transfer of large-scale 3D radiance fields."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from .api import FinishedCapture, TrainedScene

__version__ = "0.1.0"
__all__ = ["__version__", "load", "read"]


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
    inside: bool | None = None,
    activated: bool = False,
) -> "FinishedCapture":
    """A finished capture of 3D Gaussians, ready to restyle and write: a file of any format that is installed.

    `views`, `up` and `inside` are those of `fprf restyle`: how it is looked at. `activated` reads numbers that
    look activated already as such; `capture.notes` of what is returned says where they do. Raises DataError
    where it cannot be read.
    """
    from .api import FinishedCapture
    from .io.paths import as_path
    from .plugins.conversion import three_numbers
    from .splats.config import LookConfig
    from .splats.files import read_capture

    direction = None if up is None else three_numbers("up", up)
    look = LookConfig(views=views, up=direction, inside=inside, activated=activated)
    return FinishedCapture(read_capture(as_path(path), activated=activated), look)
