"""What can be turned when a scene is trained: the method once as it is, then once with each knob changed, equally long."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..config import TrainConfig
from ..errors import ConfigError
from ..plugins import slots
from ..training.run import Run
from ..training.trainer import Report, train
from .front import Point
from .knobs import as_rendered
from .points import Scenes, measure
from .subject import Subject
from .timing import Watch

__all__ = ["VARIANTS", "trained_points", "variants"]

UNBOUNDED = 10**6
"""Steps: the minutes end it."""
VARIANTS: dict[str, Callable[[Any], Any]] = {
    "render.train_budget": lambda budget: 0.0 if budget else 1 / 512,
    "semantic.samples": lambda samples: 48 if samples < 48 else 2,
    "semantic.dim": lambda dim: max(1, dim // 2),
    "semantic.field.resolutions": lambda resolutions: (*resolutions, 2 * resolutions[-1]),
    "datamanager.semantic_share": lambda share: 1.0 if share < 1 else 0.25,
    "datamanager.rays": lambda rays: 2 * rays,
    "loss.penalty_every": lambda every: 1 if every > 1 else 8,
    "content.moves_density": lambda moves: not moves,
    "content.field.channels": lambda channels: max(8, channels // 2),
    "content.field.resolutions": lambda resolutions: resolutions[:-1] or resolutions,
    "sampler.final": lambda final: 2 * final,
}
"""A second value of each training knob, from the first."""


def variants(config: TrainConfig) -> dict[str, TrainConfig]:
    """The config as it is, and with one knob changed, by what was changed; knobs that it lacks are left out."""
    found = {"as it is": config}
    for path, second in VARIANTS.items():
        value: Any = config
        try:
            for name in path.split("."):
                value = getattr(value, name)
            changed = slots.replace(config, path, second(value))
        except (AttributeError, ConfigError):  # a plug-in without that field, or with another range
            continue
        if changed != config:
            found[f"{path} {second(value)}"] = changed
    return found


def trained_points(
    minutes: float, subject: Subject, scenes: Scenes, watch: Watch, folder: Path, progress: Callable[[int, int, str], None]
) -> list[Point]:
    """Each variant trained so long and judged by the photographs. Features that lie in the cache cost nothing."""
    found = []
    chosen = variants(replace(subject.trained.config, minutes=minutes, steps=UNBOUNDED))
    for i, (name, variant) in enumerate(chosen.items()):
        progress(i, len(chosen), "training variants")
        prepared = subject.prepare(variant)
        run = Run(folder / f"variant-{i}")
        run.root.mkdir(parents=True)
        last: list[Report] = []
        model = train(variant, prepared, run, last.append).requires_grad_(False).eval()
        trained = replace(subject.trained, config=variant, model=model)
        (point,) = measure([as_rendered("trained", f"{name} ({last[-1].step} steps)", trained)], scenes, watch)
        found.append(replace(point, train_seconds=last[-1].seconds))
    progress(len(chosen), len(chosen), "training variants")
    return found
