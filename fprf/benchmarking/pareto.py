"""`fprf bench pareto`: time against error for every knob, plain and restyled, and which settings nothing beats."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from rich.table import Table
from torch import Tensor

from ..datamanagers.images import load_image
from ..errors import FprfError, UsageError
from ..io.figures import number
from ..io.images import write_image
from ..plugins.stylizers.config import RegionOtConfig
from ..rendering.cameras import Cameras
from ..style.look import Restyle
from ..training.loading import Trained, load_run
from ..training.prepare import scene_of
from ..training.restyle import restyle
from ..training.run import view_names
from .config import ParetoConfig
from .front import Point, front
from .knobs import BUDGETS, as_rendered, plain_settings, styled_settings
from .plot import Panel, draw
from .points import Scenes, measure
from .report import Outcome, document, table
from .subject import Subject, find, settings, size_of, small_view, watch_of
from .timing import Watch
from .train_knobs import trained_points
from .views import count, exact, view_rays

__all__ = ["pareto"]

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
    counters = {name: count(trained.model.parts, rays, budget).shares for name, budget in BUDGETS.items()}
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
        scene = scene_of(replace(config, data=subject.data))
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
