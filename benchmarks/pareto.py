"""Pareto: time against error for every knob of rendering, plain and restyled, and which settings no other one
beats.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from fprf.checks import at_least
from fprf.config import RenderConfig
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.rendering.cameras import Cameras
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.training.field_scene import Trained
from fprf.training.quality import PRESETS, QualityConfig, at_quality
from fprf.training.views import render_view

from .common import BenchConfig, Progress, bench_run
from .report import Outcome, Spread, Watch, document, number, spread, table
from .speed import plain_planes
from .subject import (
    count,
    difference,
    exact,
    find,
    plainly,
    settings,
    size_of,
    small_view,
    view_rays,
    watch_of,
)

BUDGETS = {
    "0": 0.0,
    "1/4096": 1 / 4096,
    "1/1024": 1 / 1024,
    "1/512": 1 / 512,
    "1/256": 1 / 256,
    "1/64": 1 / 64,
    "1/16": 1 / 16,
}
CHUNKS = (1024, 4096, 32768)
SIZES = (0.25, 0.5, 0.75)
Draw = Callable[[Cameras], Annotated[Tensor, "H W 3"]]
"""Renders the one view of cameras at its size."""


@dataclass(frozen=True, kw_only=True)
class ParetoConfig(BenchConfig):
    """Time against error, knob by knob."""

    views: int = 1
    """Held-out views that times and errors are taken on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("views", self.views, 1)


class Point(NamedTuple):
    """One setting of one knob, everything else as the run has it."""

    name: str
    """Knob and value."""
    seconds: Spread
    """Of a view."""
    largest: float
    """Largest colour error against the exact result."""
    rms: float
    """Root-mean-square colour error against it."""


def knobs(trained: Trained, look: Restyle | None) -> Iterator[tuple[str, Draw]]:
    """Every value of every knob, by name."""
    render = trained.config.render
    model = trained.model
    facts = trained.known.facts

    def drawer(trained: Trained, render: RenderConfig) -> Draw:
        return lambda camera: render_view(trained.model, facts, camera, 0, render, look).rgb

    yield "run as trained", drawer(trained, render)
    for preset in PRESETS:
        chosen = at_quality(trained, QualityConfig(quality=preset))
        yield f"quality {preset}", drawer(chosen, chosen.config.render)
    for name, budget in BUDGETS.items():
        yield f"budget {name}", drawer(trained, replace(render, budget=budget))
    for chunk in CHUNKS:
        yield f"chunk {chunk}", drawer(trained, replace(render, chunk=chunk))
    for size in SIZES:
        yield f"resolution x {size:g}", drawer(trained, replace(render, resolution=size))

    def without_kernels(camera: Cameras) -> Tensor:
        width, height = (int(v) for v in camera.size[0])
        with plain_planes(model):
            return (
                plainly(model, facts, view_rays(model, camera, 0), render, look).view(height, width, 3).cpu()
            )

    yield "kernels none", without_kernels
    if look is not None:
        still = replace(look, strength=0.0)
        yield "style at strength 0", lambda camera: render_view(model, facts, camera, 0, render, still).rgb


def measure(
    chosen: Mapping[str, Draw],
    cameras: Sequence[Cameras],
    truth: Tensor,
    watch: Watch,
    progress: Callable[[int, int], None],
) -> list[Point]:
    """One point a setting; times are taken in turn. `truth` holds the exact colours of all views, flat."""

    def images(draw: Draw) -> Tensor:
        return torch.cat([draw(camera).flatten() for camera in cameras])

    taken = watch.in_turn({name: partial(images, draw) for name, draw in chosen.items()}, progress)
    points = []
    for name, draw in chosen.items():
        away = difference(images(draw), truth)
        points.append(
            Point(name, spread(taken[name]).map(lambda s: s / len(cameras)), away.largest, away.rms)
        )
    return points


def front(points: Sequence[Point]) -> list[Point]:
    """The points that no other one equals or beats in both time and error, fastest first."""
    kept: list[Point] = []
    for point in sorted(points, key=lambda p: (p.seconds.median, p.rms)):
        if not kept or point.rms < kept[-1].rms:
            kept.append(point)
    return kept


def pareto(config: ParetoConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """Points and fronts."""
    subject = find(root, config, folder)
    trained = subject.trained
    known = trained.known
    watch = watch_of(config, trained)
    cameras = [
        small_view(known.cameras, view, config.rays) for view in (known.test or known.train)[: config.views]
    ]
    curves: dict[str, list[Point]] = {}
    for name, look in (
        ("plain", None),
        (
            "region-ot",
            apply_style(
                trained, StyleFile(StyleConfig(references=subject.references, stylizer=RegionOtConfig()))
            ).restyle,
        ),
    ):
        # Strength 0 is judged by the plain colours: it must cost nothing and change nothing.
        chosen = dict(knobs(trained, look))
        still = {key: chosen.pop(key) for key in list(chosen) if key == "style at strength 0"}

        def told(done: int, total: int, name: str = name) -> None:
            progress(done, total, name)

        def colours(look: Restyle | None) -> Tensor:
            return torch.cat(
                [
                    exact(trained.model, known.facts, view_rays(trained.model, c, 0), look).flatten()
                    for c in cameras
                ]
            )

        curves[name] = measure(chosen, cameras, colours(look).cpu(), watch, told)
        if still:
            curves["plain"] += measure(still, cameras, colours(None).cpu(), watch, told)
    rays = view_rays(trained.model, cameras[0], 0)
    about = settings(config, trained, "") | {"view": size_of(cameras[0]), "views": config.views}
    fronts = {name: [point.name for point in front(points)] for name, points in curves.items()}
    extra = {
        "points": {
            name: [
                {
                    "name": point.name,
                    **{
                        key: float(f"{1e3 * value:.5g}")
                        for key, value in point.seconds._asdict().items()
                        if key != "rounds"
                    },
                    "largest_error": point.largest,
                    "rms_error": point.rms,
                }
                for point in points
            ]
            for name, points in curves.items()
        },
        "unit": "milliseconds",
        "fronts": fronts,
        "counters_by_budget": {
            name: count(trained.model.parts, rays, budget) for name, budget in BUDGETS.items()
        },
    }
    tables = []
    for name, points in curves.items():
        rows = [
            (
                point.name,
                number(1e3 * point.seconds.median),
                f"{number(1e3 * point.seconds.low)} to {number(1e3 * point.seconds.high)}",
                f"{point.largest:.1e}",
                f"{point.rms:.1e}",
                "yes" if point.name in fronts[name] else "",
            )
            for point in points
        ]
        columns = ("", "ms", "quartiles", "largest error", "rms error", "front")
        tables.append(table(f"time against error, {name}", columns, rows))
    return Outcome(document("pareto", [], device=trained.model.device, settings=about, extra=extra), tables)


def main(argv: list[str]) -> int:
    """`python -m benchmarks pareto [RUN] [flags]`."""
    return bench_run("python -m benchmarks pareto", ParetoConfig(), argv, pareto)
