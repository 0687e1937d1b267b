"""Pareto: time against error for every knob, plain and restyled, and which settings no other one beats."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from rich.table import Table
from torch import Tensor

from fprf.checks import at_least, positive
from fprf.datamanagers.images import load_image
from fprf.errors import FprfError, UsageError
from fprf.io.figures import number
from fprf.io.images import Picture, write_image
from fprf.io.maps import palette
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.rendering.cameras import Cameras
from fprf.style.look import Restyle
from fprf.style.restyle import restyle
from fprf.training.loading import Trained, load_run
from fprf.training.prepare import read_scene
from fprf.training.run import view_names

from .common import BenchConfig, bench_run
from .knobs import BUDGETS, Point, Scenes, as_rendered, front, measure, plain_settings, styled_settings, trained_points
from .report import Outcome, Watch, document, table
from .subject import Subject, count, exact, find, settings, size_of, small_view, view_rays, watch_of


@dataclass(frozen=True, kw_only=True)
class ParetoConfig(BenchConfig):
    """Time against error, knob by knob."""

    views: int = 1
    """Held-out views that times and errors are taken on."""
    also: tuple[Path, ...] = ()
    """Other runs of the same scene: each is a point by its method's name."""
    train_minutes: float | None = None
    """Also train the method with each training knob changed for so many minutes, and judge that; none = don't."""
    plot: Path | None = None
    """PNG of the curves; none = beside --output, with its name."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("views", self.views, 1)
        if self.train_minutes is not None:
            positive("train_minutes", self.train_minutes)


WIDTH, HEIGHT = 900, 620
LEFT, RIGHT, TOP, BOTTOM = 90, 30, 50, 60
INK, FAINT, PAPER = (40, 40, 44), (222, 222, 226), (255, 255, 255)
FONT = cv2.FONT_HERSHEY_SIMPLEX
LEAST = 1e-9
"""Errors are shown from here on: an exact setting has none, and a logarithm."""


class Panel(NamedTuple):
    """One picture."""

    title: str
    points: Sequence[Point]
    front: Sequence[Point]
    value: Callable[[Point], float | None]
    label: str
    """Of the upright axis."""
    log: bool
    """Whether that axis is logarithmic."""


def draw(panels: Sequence[Panel]) -> Picture:
    """All panels, two beside each other."""
    drawn = [_panel(panel) for panel in panels] or [np.full((HEIGHT, WIDTH, 3), 255, np.uint8)]
    if len(drawn) > 1 and len(drawn) % 2:
        drawn.append(np.full_like(drawn[0], 255))
    rows = [np.concatenate(drawn[i : i + 2], 1) for i in range(0, len(drawn), 2)]
    return np.concatenate(rows, 0)


def ticks(low: float, high: float, *, log: bool, most: int = 7) -> list[float]:
    """Round values within [low, high]: powers of ten times 1, 2, 5, or multiples of such; at least the two ends' nearest."""
    if log:
        exponents = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        for steps in ((1, 2, 5), (1, 3), (1,)):
            found = [s * 10.0**e for e in exponents for s in steps if low <= s * 10.0**e <= high]
            if len(found) <= most:
                break
        return found[:: -(-len(found) // most)] if found else [low, high]
    step = 10.0 ** math.floor(math.log10(max(high - low, 1e-12)))
    width = next(step * m for m in (0.2, 0.5, 1, 2, 5, 10) if (high - low) / (step * m) <= most)
    return [width * k for k in range(math.ceil(low / width), math.floor(high / width) + 1)]


class _Axis(NamedTuple):
    low: float
    high: float
    first: int
    """Pixel of the low end."""
    last: int
    log: bool

    def at(self, value: float) -> int:
        low, high, here = (math.log10(v) for v in (self.low, self.high, value)) if self.log else (self.low, self.high, value)
        return round(self.first + (here - low) / (high - low) * (self.last - self.first))


def _axis(values: Sequence[float], first: int, last: int, *, log: bool) -> _Axis:
    low, high = min(values), max(values)
    if log:
        return _Axis(low / 1.3, high * 1.3, first, last, log)
    edge = 0.08 * (high - low) or 0.5
    return _Axis(low - edge, high + edge, first, last, log)


def _panel(panel: Panel) -> Picture:
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    shown = [(p, 1e3 * p.seconds.median, _shown(panel, value)) for p in panel.points if (value := panel.value(p)) is not None]
    across = _axis([t for _, t, _ in shown], LEFT, WIDTH - RIGHT, log=True)
    up = _axis([v for _, _, v in shown], HEIGHT - BOTTOM, TOP, log=panel.log)
    _frame(image, panel, across, up)
    knobs = list(dict.fromkeys(p.knob for p in panel.points))
    colours = {k: tuple(int(255 * c) for c in rgb) for k, rgb in zip(knobs, palette(len(knobs)).tolist(), strict=True)}
    line = [(across.at(1e3 * p.seconds.median), up.at(_shown(panel, panel.value(p) or 0.0))) for p in panel.front]
    cv2.polylines(image, [np.array(line, np.int32)], False, INK, 1, cv2.LINE_AA)
    taken: list[tuple[int, int, int, int]] = []
    for point, milliseconds, value in sorted(shown, key=lambda s: s[0] not in panel.front):
        x, y = across.at(milliseconds), up.at(value)
        best = point in panel.front
        cv2.circle(image, (x, y), 6 if best else 4, colours[point.knob], -1 if best else 2, cv2.LINE_AA)
        _label(image, point.name, x, y, taken, INK if best else (130, 130, 134))
    return image


def _shown(panel: Panel, value: float) -> float:
    return max(value, LEAST) if panel.log else value


def _frame(image: Picture, panel: Panel, across: _Axis, up: _Axis) -> None:
    for value in ticks(across.low, across.high, log=True):
        x = across.at(value)
        cv2.line(image, (x, TOP), (x, HEIGHT - BOTTOM), FAINT, 1)
        _text(image, f"{value:g}", (x, HEIGHT - BOTTOM + 20), centred=True)
    for value in ticks(up.low, up.high, log=panel.log):
        y = up.at(value)
        cv2.line(image, (LEFT, y), (WIDTH - RIGHT, y), FAINT, 1)
        text = f"{value:.0e}" if panel.log else f"{value:g}"
        _text(image, text, (LEFT - 8 - _width(text), y + 4))
    cv2.rectangle(image, (LEFT, TOP), (WIDTH - RIGHT, HEIGHT - BOTTOM), INK, 1)
    _text(image, panel.title, (LEFT, 30), size=0.6)
    _text(image, "milliseconds a view", ((LEFT + WIDTH - RIGHT) // 2, HEIGHT - 14), centred=True)
    _text(image, panel.label, (8, TOP - 12))


def _label(
    image: Picture, text: str, x: int, y: int, taken: list[tuple[int, int, int, int]], colour: tuple[int, int, int]
) -> None:
    """The name beside its point, where no other name is; left out where there is no room."""
    width = _width(text)
    for left, base in ((x + 9, y - 5), (x + 9, y + 14), (x - 9 - width, y - 5), (x - 9 - width, y + 14)):
        box = (left, base - 10, left + width, base + 3)
        inside = box[0] >= LEFT and box[2] <= WIDTH - RIGHT and box[1] >= TOP and box[3] <= HEIGHT - BOTTOM
        if inside and not any(_meet(box, other) for other in taken):
            taken.append(box)
            _text(image, text, (left, base), colour=colour)
            return


def _meet(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _width(text: str, size: float = 0.42) -> int:
    return int(cv2.getTextSize(text, FONT, size, 1)[0][0])


def _text(
    image: Picture,
    text: str,
    at: tuple[int, int],
    *,
    size: float = 0.42,
    centred: bool = False,
    colour: tuple[int, int, int] = INK,
) -> None:
    left = at[0] - _width(text, size) // 2 if centred else at[0]
    cv2.putText(image, text, (left, at[1]), FONT, size, colour, 1, cv2.LINE_AA)


Progress = Callable[[int, int, str], None]


def pareto(config: ParetoConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """Points, fronts, and a picture of them."""
    subject = find(root, config, folder)
    trained = subject.trained
    known, watch = trained.known, watch_of(config, trained)
    views = (known.test or known.train)[: config.views]
    cameras = [small_view(known.cameras, view, config.rays) for view in views]
    truth, missing = _photographs(subject, views, cameras)
    stylizer = RegionOtConfig()
    styled = restyle(trained, subject.references, stylizer)
    curves: dict[str, list[Point]] = {}
    for name, look, chosen, photographs in (
        ("plain", None, plain_settings(trained, styled), truth),
        ("stylised, region-ot", styled.restyle, styled_settings(trained, styled, stylizer), None),
    ):
        scenes = Scenes(cameras, photographs, [_exact(trained, camera, look) for camera in cameras])
        curves[name] = measure(list(chosen), scenes, watch, partial(_told, progress, name))
    by_photographs = Scenes(cameras, truth, None)
    for other in config.also:
        curves["plain"] += _other_run(load_run(other, config.device), [known.names[v] for v in views], by_photographs, watch)
    if config.train_minutes is not None:
        curves["trained"] = trained_points(config.train_minutes, subject, by_photographs, watch, folder, progress)
    rays = view_rays(trained.model, cameras[0], 0)
    counters = {name: count(trained.model.parts, rays, budget) for name, budget in BUDGETS.items()}
    return _outcome(config, subject, curves, missing, cameras[0], counters)


def _told(progress: Progress, name: str, done: int, total: int) -> None:
    progress(done, total, name)


def _exact(trained: Trained, camera: Cameras, look: Restyle | None) -> Tensor:
    width, height = (int(v) for v in camera.size[0])
    rgb = exact(trained.model, trained.known.facts, view_rays(trained.model, camera, 0), look)
    return rgb.view(height, width, 3).cpu()


def _photographs(subject: Subject, views: Sequence[int], cameras: Sequence[Cameras]) -> tuple[list[Tensor] | None, str]:
    """What the views really look like, at the size that they are rendered at; or why that is not known."""
    config, known = subject.trained.config, subject.trained.known
    try:
        scene = read_scene(replace(config, data=subject.data))
        if tuple(view_names(scene.paths)) != known.names:
            raise UsageError(f"{subject.data}: its images are not those of the run; name the folder with --data")
        images = []
        for view, camera in zip(views, cameras, strict=True):
            width, height = (int(v) for v in camera.size[0])
            image = load_image(scene.paths[view], (width, height), known.facts.background)
            images.append(torch.from_numpy(image).float() / 255)
    except FprfError as error:
        return None, str(error)
    return images, ""


def _other_run(other: Trained, names: Sequence[str], scenes: Scenes, watch: Watch) -> list[Point]:
    """Another run on the same views: there is nothing exact to compare it with but the photographs."""
    absent = [name for name in names if name not in other.known.names]
    if absent:
        raise UsageError(f"--also {other.run.root}: has no view {absent[0]}; name runs of the same scene")
    points = measure([as_rendered("method", other.method, other)], scenes, watch)
    return [replace(point, train_seconds=other.seconds) for point in points]


def _loss(point: Point) -> float | None:
    return None if point.psnr is None else -point.psnr


def _outcome(
    config: ParetoConfig,
    subject: Subject,
    curves: dict[str, list[Point]],
    missing: str,
    camera: Cameras,
    counters: dict[str, dict[str, float]],
) -> Outcome:
    panels, fronts, tables = [], {}, []
    for name, points in curves.items():
        by_error, by_truth = front(points, lambda p: p.rms), front(points, _loss)
        fronts[name] = {"rms_error": [p.name for p in by_error], "psnr": [p.name for p in by_truth]}
        tables.append(_table(name, points, by_error, by_truth))
        if by_error:
            panels.append(Panel(f"{name}: error against exact", points, by_error, lambda p: p.rms, "rms error", log=True))
        if by_truth:
            panels.append(Panel(f"{name}: against photographs", points, by_truth, lambda p: p.psnr, "PSNR, dB", log=False))
    trained = subject.trained
    about = settings(config, trained, missing) | {"view": size_of(camera), "views": config.views}
    extra = {
        "points": {name: [p.json() for p in points] for name, points in curves.items()},
        "fronts": fronts,
        "counters_by_budget": counters,
    }
    made = document("pareto", [], device=trained.model.device, settings=about, extra=extra)
    plot = config.plot or (config.output.with_suffix(".png") if config.output is not None else None)
    if plot is not None:
        write_image(plot, draw(panels))
    return Outcome(made, tables)


def _table(name: str, points: Sequence[Point], by_error: Sequence[Point], by_truth: Sequence[Point]) -> Table:
    def cells(point: Point) -> list[str]:
        marks = [word for word, chosen in (("error", by_error), ("PSNR", by_truth)) if point in chosen]
        return [
            point.name,
            number(1e3 * point.seconds.median),
            f"{number(1e3 * point.seconds.low)} to {number(1e3 * point.seconds.high)}",
            number(point.rays_per_second),
            *("" if value is None else f"{value:.1e}" for value in (point.largest, point.rms)),
            "" if point.psnr is None else f"{point.psnr:.2f}",
            ", ".join(marks),
        ]

    columns = ("", "ms", "quartiles", "rays/s", "largest error", "rms error", "PSNR", "on the front of")
    return table(f"time against error, {name}", columns, map(cells, points))


def main(argv: list[str]) -> int:
    """`python -m benchmarks pareto [RUN] [flags]`."""
    return bench_run("python -m benchmarks pareto", ParetoConfig(), argv, pareto)
