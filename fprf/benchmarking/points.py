"""Settings to points: each one's time on the same views, and how far its pictures are from the exact and the real ones."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..evaluation.metrics import psnr
from ..rendering.cameras import Cameras
from .front import Point
from .knobs import Setting
from .timing import Watch, spread
from .views import difference

__all__ = ["Scenes", "measure"]


class Scenes(NamedTuple):
    """The views that all settings are judged by."""

    cameras: Sequence[Cameras]
    """Each holds one view."""
    photographs: Sequence[Annotated[Tensor, "H W 3"]] | None
    """What they really look like, if that is known and means something."""
    exact: Sequence[Annotated[Tensor, "H W 3"]] | None
    """What the model says when nothing is skipped, if all settings are of one model."""


def measure(
    settings: Sequence[Setting],
    scenes: Scenes,
    watch: Watch,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Point]:
    """One point a setting; times are taken in turn."""
    calls = {setting.name: partial(_images, setting, scenes.cameras) for setting in settings}
    taken = watch.in_turn(calls, progress)
    pixels = sum(int(camera.size.prod()) for camera in scenes.cameras)
    points = []
    for setting in settings:
        images = calls[setting.name]()
        away = None if scenes.exact is None else difference(_flat(images), _flat(scenes.exact))
        seconds = spread(taken[setting.name])
        points.append(
            Point(
                knob=setting.knob,
                value=setting.value,
                seconds=seconds.map(lambda s: s / len(scenes.cameras)),
                rays_per_second=pixels / seconds.median,
                largest=None if away is None else away.largest,
                rms=None if away is None else away.rms,
                psnr=None if scenes.photographs is None else _mean_psnr(images, scenes.photographs),
            )
        )
    return points


def _images(setting: Setting, cameras: Sequence[Cameras]) -> list[Tensor]:
    return [setting.draw(camera, 0) for camera in cameras]


def _flat(images: Sequence[Tensor]) -> Tensor:
    return torch.cat([image.flatten() for image in images])


def _mean_psnr(images: Sequence[Tensor], photographs: Sequence[Tensor]) -> float:
    return sum(psnr(image, truth) for image, truth in zip(images, photographs, strict=True)) / len(images)
