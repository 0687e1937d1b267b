"""What a benchmark measures: a trained run, its images where they are at hand, and photographs for styles."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from ..config import TrainConfig
from ..errors import FprfError, UsageError, WeightsError
from ..io.images import write_image
from ..rendering.cameras import Cameras
from ..town.layout import build_town
from ..town.palettes import palette
from ..town.render import render, walk
from ..training.loading import Trained, load_run
from ..training.model import Model, build_model
from ..training.prepare import Prepared, prepare
from ..training.run import view_names
from .config import BenchConfig
from .timing import Watch

__all__ = [
    "LOOKS",
    "Subject",
    "attempt",
    "find",
    "fresh_model",
    "settings",
    "size_of",
    "small_view",
    "test_view",
    "town_references",
    "watch_of",
]

LOOKS = {"autumn": (3, 9), "winter": (5, 14), "night": (2, 4)}
"""Palette of each default reference, with the seed of the town that it shows and the view of it."""


class Subject(NamedTuple):
    """One run and what goes with it."""

    trained: Trained
    references: tuple[Path, ...]
    data: Path
    """Where its images should lie."""
    prepare: Callable[[TrainConfig], Prepared]
    """Images and features for the run's config, or one that differs in its batches. Raises FprfError where they are not
    at hand."""


def find(root: Path, config: BenchConfig, folder: Path) -> Subject:
    """The run in `root`; `folder` takes what is made on the way."""
    trained = load_run(root, config.device)
    data = config.data or trained.config.data or Path(trained.known.data)

    def prepared(chosen: TrainConfig) -> Prepared:
        made = prepare(replace(chosen, data=data), saved=trained.known.facts)
        if tuple(view_names(made.scene.paths)) != trained.known.names:
            raise UsageError(f"{data}: its images are not those of the run; name the folder with --data")
        for kind in ("content_encoder", "semantic_encoder"):
            own, now = getattr(trained.known.facts, kind), getattr(made.facts, kind)
            if own != now:
                raise WeightsError(f"{kind.replace('_', ' ')}: the run was trained with {own}, this is {now}; train it again")
        return made

    return Subject(trained, config.references or town_references(folder / "references"), data, prepared)


def attempt(subject: Subject) -> tuple[Prepared | None, str]:
    """What training needs; or why it is not at hand: rendering can be measured without."""
    try:
        return subject.prepare(subject.trained.config), ""
    except FprfError as error:
        return None, str(error)


def fresh_model(trained: Trained) -> Model:
    """A copy of the run's model that may be trained."""
    model = build_model(trained.config, trained.known.facts)
    model.load_state_dict(trained.model.state_dict())
    return model.to(trained.model.device)


def watch_of(config: BenchConfig, trained: Trained) -> Watch:
    """How times of this run are taken."""
    return Watch(config.repeats, trained.model.device, config.clock)


def settings(config: BenchConfig, trained: Trained, missing: str) -> dict[str, object]:
    """What figures depend on; `missing` says why some are absent."""
    return {
        "method": trained.method,
        "scene": trained.known.name,
        "trained_steps": trained.step,
        "rounds": config.repeats,
        "clock": config.clock,
        "budget": trained.config.render.budget,
        "chunk": trained.config.render.chunk,
        "without": missing,
    }


def test_view(config: BenchConfig, trained: Trained) -> Cameras:
    """The first held-out view, no larger than `config.rays`."""
    known = trained.known
    return small_view(known.cameras, (known.test or known.train)[0], config.rays)


def size_of(cameras: Cameras) -> str:
    """Width and height of the first view."""
    width, height = (int(v) for v in cameras.size[0])
    return f"{width}x{height}"


def small_view(cameras: Cameras, view: int, rays: int) -> Cameras:
    """One view alone (as view 0), no larger than so many pixels."""
    one = cameras.select(torch.tensor([view]))
    area = float(one.size.prod())
    return one if area <= rays else one.resized((one.size * (rays / area) ** 0.5).floor().clamp_min(1))


def town_references(folder: Path, *, width: int = 160, height: int = 120) -> tuple[Path, ...]:
    """One picture of another town for each look."""
    paths = []
    for look, (seed, view) in LOOKS.items():
        path = folder / f"{look}.png"
        camera = walk(seed=seed, views=20, width=width, height=height)[view]
        write_image(path, render(build_town(seed), camera, palette(look)).rgb)
        paths.append(path)
    return tuple(paths)
