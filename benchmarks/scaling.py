"""Scaling: what a part of the work costs against how much there is of it: images, pixels, references, points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from fprf.checks import at_least
from fprf.io.figures import number
from fprf.ops import triplane
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.style.restyle import restyle
from fprf.training.prepare import Prepared
from fprf.training.views import render_view

from .common import BenchConfig, bench_run
from .report import Outcome, Spread, document, spread, table
from .speed import draw_points, forward_backward, largest_planes
from .subject import Subject, attempt, find, settings, test_view, watch_of


@dataclass(frozen=True, kw_only=True)
class ScalingConfig(BenchConfig):
    """Cost against the number of images, pixels, references and points."""

    images: tuple[int, ...] = (2, 4, 8)
    """Training images, where the scene has so many; their features are extracted anew."""
    downscales: tuple[float, ...] = (4.0, 2.0, 1.0)
    """Sizes of the rendered view, relative to the run's."""
    styles: tuple[int, ...] = (1, 2, 4, 8)
    """References of a style; the given ones are taken again and again."""
    points: tuple[int, ...] = (4096, 16384, 65536)
    """Points of a tri-plane lookup, forward and backward."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("images", "downscales", "styles", "points"):
            for value in getattr(self, name):
                at_least(name, value, 1)


Progress = Callable[[int, int, str], None]


class Series(NamedTuple):
    """Cost at several sizes."""

    name: str
    of: str
    """What there is more and more of."""
    sizes: tuple[int, ...]
    milliseconds: tuple[Spread, ...]

    def json(self) -> dict[str, object]:
        """The series, and how cost grows."""
        return {
            "name": self.name,
            "of": self.of,
            "sizes": list(self.sizes),
            "milliseconds": [float(f"{m.median:.5g}") for m in self.milliseconds],
            "low": [float(f"{m.low:.5g}") for m in self.milliseconds],
            "high": [float(f"{m.high:.5g}") for m in self.milliseconds],
            "exponent": exponent(self.sizes, [m.median for m in self.milliseconds]),
        }


def scaling(config: ScalingConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """All series."""
    subject = find(root, config, folder)
    trained = subject.trained
    found: list[Series] = []
    progress(0, 4, "images")
    prepared, missing = attempt(subject)
    if prepared is not None:
        found += _images(config, subject, prepared, folder)
    progress(1, 4, "pixels")
    found.append(_pixels(config, subject))
    progress(2, 4, "references")
    found += _references(config, subject)
    progress(3, 4, "points")
    found += _points(config, subject)
    progress(4, 4, "done")
    extra = {"series": [series.json() for series in found]}
    made = document("scaling", [], device=trained.model.device, settings=settings(config, trained, missing), extra=extra)
    return Outcome(made, [table("cost against size", ("", "size", "ms", "ms each", "grows as"), _cells(found))])


def exponent(sizes: Sequence[int], costs: Sequence[float]) -> float | None:
    """The p of cost = a size^p that fits best on logarithmic axes; None where fewer than two sizes differ."""
    x, y = ([math.log(max(value, 1e-300)) for value in values] for values in (sizes, costs))
    if len(set(x)) < 2:
        return None
    middle, level = sum(x) / len(x), sum(y) / len(y)
    return sum((a - middle) * (b - level) for a, b in zip(x, y, strict=True)) / sum((a - middle) ** 2 for a in x)


def _images(config: ScalingConfig, subject: Subject, prepared: Prepared, folder: Path) -> list[Series]:
    """Features from nothing, once a size; batches from what they left."""
    trained, watch = subject.trained, watch_of(config, subject.trained)
    knobs = trained.config
    sizes = tuple(n for n in config.images if n <= len(prepared.scene.train))
    features, managers = [], {}
    for n in sizes:

        def extract(n: int = n) -> None:
            managers[n] = knobs.datamanager.build(
                scene=replace(prepared.scene, train=prepared.scene.train[:n]),
                content=knobs.content.encoder.build(),
                semantic=knobs.semantic.encoder.build() if knobs.semantic.encoder is not None else None,
                dim=knobs.semantic.dim,
                cache=folder / f"features-{n}",
                seed=knobs.seed,
            )

        features.append(spread([1e3 * watch.once(extract)]))
    taken = watch.in_turn({str(n): partial(managers[n].batch, config.seed) for n in sizes})
    return [
        Series("images and features, from nothing", "images", sizes, tuple(features)),
        Series("a batch", "images", sizes, tuple(spread(taken[str(n)]).map(_milli) for n in sizes)),
    ]


def _pixels(config: ScalingConfig, subject: Subject) -> Series:
    trained = subject.trained
    known, render = trained.known, trained.config.render
    whole = test_view(config, trained)
    cameras = {int(c.size.prod()): c for c in (whole.scaled(d) for d in config.downscales)}
    calls = {str(n): partial(render_view, trained.model, known.facts, c, 0, render) for n, c in cameras.items()}
    taken = watch_of(config, trained).in_turn(calls)
    sizes = tuple(sorted(cameras))
    return Series("a view", "pixels", sizes, tuple(spread(taken[str(n)]).map(_milli) for n in sizes))


def _references(config: ScalingConfig, subject: Subject) -> list[Series]:
    trained, camera = subject.trained, test_view(config, subject.trained)
    known, render = trained.known, trained.config.render
    given = subject.references
    many = {n: tuple(given[i % len(given)] for i in range(n)) for n in config.styles}
    looks = {n: restyle(trained, paths, RegionOtConfig()).restyle for n, paths in many.items()}
    calls: dict[str, Callable[[], object]] = {}
    for n in config.styles:
        calls[f"dictionary {n}"] = partial(restyle, trained, many[n], RegionOtConfig())
        calls[f"view {n}"] = partial(render_view, trained.model, known.facts, camera, 0, render, looks[n])
    taken = watch_of(config, trained).in_turn(calls)
    return [
        Series(label, "references", config.styles, tuple(spread(taken[f"{key} {n}"]).map(_milli) for n in config.styles))
        for key, label in (("dictionary", "a style, from photographs"), ("view", "a restyled view"))
    ]


def _points(config: ScalingConfig, subject: Subject) -> list[Series]:
    planes, device = largest_planes(subject.trained.model), subject.trained.model.device
    if planes is None:
        return []
    table, resolutions = planes.table.detach().clone(), planes.resolutions
    drawn = {n: draw_points(n, config.seed, device) for n in config.points}
    calls = {str(n): partial(forward_backward, triplane.lookup, p, table, resolutions) for n, p in drawn.items()}
    taken = watch_of(config, subject.trained).in_turn(calls)
    costs = tuple(spread(taken[str(n)]).map(_milli) for n in config.points)
    return [Series("tri-plane forward + backward", "points", config.points, costs)]


def _cells(found: Sequence[Series]) -> list[list[str]]:
    rows = []
    for series in found:
        power = exponent(series.sizes, [m.median for m in series.milliseconds])
        for i, (size, cost) in enumerate(zip(series.sizes, series.milliseconds, strict=True)):
            grows = f"{series.of} ^ {power:.2f}" if i == 0 and power is not None else ""
            name = series.name if i == 0 else ""
            rows.append([name, f"{size} {series.of}", number(cost.median), number(cost.median / size), grows])
    return rows


def _milli(seconds: float) -> float:
    return 1e3 * seconds


def main(argv: list[str]) -> int:
    """`python -m benchmarks scaling [RUN] [flags]`."""
    return bench_run("python -m benchmarks scaling", ScalingConfig(), argv, scaling)
