"""Feed-forward photorealistic style transfer of large-scale 3D radiance fields."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from .api import FinishedCapture, TrainedScene

__version__ = "0.1.0"
__all__ = ["__version__", "load", "read"]


def load(
    run: str | Path, *, device: str = "auto", quality: Literal["draft", "standard", "best"] | None = None
) -> "TrainedScene":
    """A trained run, ready to restyle and render; needs neither its images nor, before `stylize`, its
    encoders.

    `device` is cpu, cuda, mps or auto; `quality` trades time for error as in `fprf render`. Raises
    CheckpointError where `run` is no run folder or holds no checkpoint.
    """
    # torch is imported when a scene is
    from functools import cache

    from .api import TrainedScene
    from .training.loading import open_run
    from .training.quality import QualityConfig

    trained = open_run(Path(run), device, QualityConfig(quality=quality))
    return TrainedScene(trained, encoders=cache(trained.scene.encoders))


def read(
    path: str | Path,
    *,
    views: int = 32,
    up: tuple[float, float, float] | None = None,
    inside: bool | None = None,
) -> "FinishedCapture":
    """A finished capture of 3D Gaussians, ready to restyle and write: a file of any format that is installed.

    `views`, `up` and `inside` are those of `fprf restyle`: how it is looked at. Raises DataError where it
    cannot be read.
    """
    from .api import FinishedCapture
    from .splats.config import LookConfig
    from .splats.files import read_capture

    return FinishedCapture(read_capture(Path(path)), LookConfig(views=views, up=up, inside=inside))
