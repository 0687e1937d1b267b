"""Feed-forward photorealistic style transfer of large-scale 3D radiance fields."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from .api import TrainedScene

__version__ = "0.1.0"
__all__ = ["__version__", "load"]


def load(
    run: str | Path, *, device: str = "auto", quality: Literal["draft", "standard", "best"] | None = None
) -> "TrainedScene":
    """A trained run, ready to restyle and render; needs neither its images nor, before `stylize`, its encoders.

    `device` is cpu, cuda, mps or auto; `quality` trades time for error as in `fprf render`. Raises CheckpointError where
    `run` is no run folder or holds no checkpoint.
    """
    # torch is imported when a scene is
    from functools import cache

    from .api import TrainedScene
    from .training.loading import open_run
    from .training.quality import QualityConfig

    trained = open_run(Path(run), device, QualityConfig(quality=quality))
    return TrainedScene(trained, encoders=cache(trained.scene.encoders))
