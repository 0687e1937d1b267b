"""A flight by its name: what `--path` of the verbs and `path` of the Python interface understand."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from ..errors import UsageError
from . import paths
from .camera_path import read_camera_path
from .cameras import Cameras

__all__ = ["MOTIONS", "make_path", "upwards"]

MOTIONS = ("spiral", "orbit", "interpolate", "dataset")


def make_path(cameras: Cameras, views: Sequence[int], motion: str, frames: int) -> Cameras:
    """Cameras of a motion, or of a camera-path JSON file.

    `interpolate` and `dataset` go through `views` of the captured `cameras`. `frames` are those of a spiral or orbit, and
    about those of an interpolation; a file and the captured views bring their own number. Raises UsageError for what is
    neither, DataError for a file that is no camera path.
    """
    chosen = torch.tensor(list(views), dtype=torch.int64)
    if motion == "dataset":
        return paths.dataset(cameras, chosen)
    if motion == "spiral":
        return paths.spiral(cameras, frames)
    if motion == "orbit":
        return paths.orbit(cameras, frames)
    if motion == "interpolate":
        order = paths.tour(cameras, chosen)
        between = max(0, round((frames - 1) / max(1, len(order) - 1)) - 1)
        return paths.interpolate(cameras, order, between)
    file = Path(motion)
    if not file.is_file():
        raise UsageError(f"--path {motion}: neither a file nor one of {', '.join(MOTIONS)}")
    return read_camera_path(file)[0]


def upwards(cameras: Cameras) -> Annotated[Tensor, "3"]:
    """The mean of the cameras' up, or, where they look straight down, against their view; world axes, not of unit length."""
    up = cameras.pose[:, :, 1].mean(dim=0)
    return cameras.pose[:, :, 2].mean(dim=0) if float(up.norm()) < 0.3 else up
