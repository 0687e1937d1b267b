"""What restyling is judged on: a trained town, views of it that are cached, and what is truly there.

The truth of a palette is the same town rendered in it through the same cameras. Light is tied to geometry: where shadows fall
and which windows are lit follows from the palette's sun and from the town, and no photograph of another town tells it. What
can be known from references is the colour of each kind of thing; the rest of the distance to the truth is nobody's.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError, UsageError
from ..rendering.cameras import Cameras
from ..town.layout import Town, build_town
from ..town.palettes import palette
from ..town.render import View, geometry, render
from ..town.write import TownSettings, is_town
from ..training.cached_view import CachedView, cache_view
from ..training.loading import Trained
from ..training.prepare import scene_of

__all__ = ["Stage", "Truth", "set_stage", "short_path", "town_folder", "town_settings", "town_view", "true_views"]

_STEP = 0.12
"""Metres between frames of the path: 7 frames on, near things have moved by a quarter of a small picture."""
_TURN = math.radians(0.8)
"""Between frames, to the left."""
_OFF = 0.01
"""By what share focal lengths and centres may differ from those of a town's camera."""


class Truth(NamedTuple):
    """What is there; palettes change none of it."""

    depth: Annotated[Tensor, "H W"]
    """Metres along the unit ray, inf = sky."""
    labels: Annotated[Tensor, "H W"]
    """int64, see `fprf.town.surface`."""


class Stage(NamedTuple):
    """A trained town and the cameras that it is judged from."""

    trained: Trained
    settings: TownSettings
    town: Town
    views: Cameras
    shown: Sequence[CachedView]
    """The judged views."""
    truth: Sequence[Truth]
    path: Cameras
    passed: Sequence[CachedView]
    """The frames of the path."""
    path_truth: Sequence[Truth]


def set_stage(trained: Trained, *, views: int, frames: int, longest: int, stride: float = 1.0) -> Stage:
    """Held-out views, evenly spread, and a path that begins at one of them (no frames, no path; longer steps with `stride`).

    Raises UsageError where the run shows no town.
    """
    settings = town_settings(trained)
    town = build_town(settings.seed, settings.extra)
    known = trained.known
    held_out = known.test or known.train
    count = min(views, len(held_out))
    chosen = torch.tensor([held_out[i * len(held_out) // count] for i in range(count)])
    cameras = known.cameras.scaled(max(1.0, float(known.cameras.size.amax()) / longest))
    judged = cameras.select(chosen)
    path = short_path(judged.select(torch.tensor([count // 2])), frames, stride)
    render = trained.config.render

    def cached(of: Cameras) -> list[CachedView]:
        return [cache_view(trained.model, known.facts, of, i, render) for i in range(len(of))]

    def true(of: Cameras) -> list[Truth]:
        found = [geometry(town, town_view(of, i)) for i in range(len(of))]
        return [Truth(torch.from_numpy(depth), torch.from_numpy(labels.astype("int64"))) for depth, labels in found]

    return Stage(trained, settings, town, judged, cached(judged), true(judged), path, cached(path), true(path))


def town_folder(trained: Trained) -> Path | None:
    """Where the town lies that a run was trained on; None where it was another scene."""
    scene = scene_of(trained.config)
    folder = scene.paths[0].parents[1]
    return folder if is_town(folder) else None


def town_settings(trained: Trained) -> TownSettings:
    """Which town a run was trained on. Raises UsageError where it was none, DataError where its record cannot be read."""
    folder = town_folder(trained)
    if folder is None:
        raise UsageError(
            f"{trained.run.root}: trained on {trained.known.name}, whose looks in other light nobody knows; "
            "train the embedded town, for example with `fprf train fprf-lite --data town`"
        )
    return _read_settings(folder)


def town_view(cameras: Cameras, view: int) -> View:
    """The town's own camera of a view. Raises DataError for one that is no centred pinhole."""
    width, height = (int(v) for v in cameras.size[view])
    focal, centre = cameras.focal[view].tolist(), cameras.centre[view].tolist()
    off = max(abs(focal[1] / focal[0] - 1), abs(2 * centre[0] / width - 1), abs(2 * centre[1] / height - 1))
    if int(cameras.lens[view]) != 0 or off > _OFF:
        raise DataError(f"view {view}: no centred pinhole with square pixels at {width}x{height}; choose another --longest")
    return View(cameras.pose[view].cpu().numpy(), (focal[0] + focal[1]) / 2, width, height)


def true_views(stage: Stage, light: str) -> list[Annotated[Tensor, "H W 3"]]:
    """The judged views as they are in the palette, in [0, 1]."""
    look = palette(light)
    pictures = [render(stage.town, town_view(stage.views, i), look).rgb for i in range(len(stage.views))]
    return [torch.from_numpy(picture).float() / 255 for picture in pictures]


def short_path(start: Cameras, frames: int, stride: float = 1.0) -> Cameras:
    """A few steps onward from a camera, slowly turning to the left: neighbouring frames see nearly the same."""
    path = start.select(torch.zeros(frames, dtype=torch.int64))
    pose = path.pose.clone()
    ahead = -start.pose[0, :2, 2]
    ahead = ahead / ahead.norm().clamp_min(1e-9)
    for step in range(frames):
        k = stride * step
        turn = pose.new_tensor(
            [[math.cos(k * _TURN), -math.sin(k * _TURN), 0], [math.sin(k * _TURN), math.cos(k * _TURN), 0], [0, 0, 1]]
        )
        pose[step, :, :3] = turn @ pose[step, :, :3]
        pose[step, :2, 3] += k * _STEP * ahead
    return Cameras(pose, path.focal, path.centre, path.size, path.distortion, path.lens)


def _read_settings(folder: Path) -> TownSettings:
    record = folder / "town.json"
    try:
        return TownSettings(**json.loads(record.read_text(encoding="utf-8"))["settings"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{record}: {error}; remove the folder {folder} and let it be rendered again") from error
