"""What a training's steps and minutes allow: the size of its images, how long it will take, and what came of it.

The rule for sizes is written down in docs/formats.md. It asks for no measurement, so that the same scene, config and kind of
device always give the same size.
"""

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from torch import Tensor

from ..config import TrainConfig
from ..datamanagers.scene import Scene
from ..errors import CheckpointError
from .events import read_history

if TYPE_CHECKING:  # which needs a scene, whose size is decided here
    from .trainer import Report

__all__ = ["Forecast", "Outcome", "find_downscale", "outcome"]


class _Pace(NamedTuple):
    """What a kind of device does, within a factor of two."""

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
    """What a training came to."""

    steps: int
    """Of the block that was trained least, where there are several."""
    psnr: float
    """Of the training rays in dB, smoothed; the mean over blocks."""
    passes: float
    """Rays drawn for each pixel of the training views."""

    @property
    def too_short(self) -> bool:
        """Whether there is nothing to be judged by yet."""
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
    """What a run's events.jsonl says of its training, or those of its blocks; None where no step was made."""
    try:
        trained = [history for history in read_history(root) if history.step and history.values["psnr"][-1] is not None]
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
