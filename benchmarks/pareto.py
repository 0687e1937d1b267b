"""Pareto: time against error for every knob, plain and restyled, and which settings no other one beats."""

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from rich.table import Table
from torch import Tensor, nn

from fprf.checks import at_least
from fprf.config import RenderConfig
from fprf.datamanagers.images import load_image
from fprf.errors import FprfError, UsageError
from fprf.evaluation.metrics import psnr
from fprf.fields.planes import Planes
from fprf.interfaces import SemanticField
from fprf.io.figures import number
from fprf.plugins.stylizers.config import RegionOtConfig, StylizerConfig
from fprf.rendering.cameras import Cameras
from fprf.style.look import Restyle
from fprf.style.restyle import Styled, restyle
from fprf.training.loading import Trained
from fprf.training.model import Facts, Model
from fprf.training.prepare import scene_of
from fprf.training.quality import PRESETS, QualityConfig, at_quality
from fprf.training.run import view_names
from fprf.training.views import render_view

from .common import BenchConfig, Progress, bench_run
from .report import Outcome, Spread, Watch, document, spread, table
from .speed import plain_planes, replaced
from .subject import Subject, count, difference, exact, find, plainly, settings, size_of, small_view, view_rays, watch_of


@dataclass(frozen=True, kw_only=True)
class ParetoConfig(BenchConfig):
    """Time against error, knob by knob."""

    views: int = 1
    """Held-out views that times and errors are taken on."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("views", self.views, 1)


BUDGETS = {"0": 0.0, "1/4096": 1 / 4096, "1/1024": 1 / 1024, "1/512": 1 / 512, "1/256": 1 / 256, "1/64": 1 / 64, "1/16": 1 / 16}
SAMPLES = (0.25, 0.5, 0.75, 1.5, 2.0, 4.0)
CHUNKS = (1024, 4096, 32768)
SIZES = (0.25, 0.5, 0.75)
Draw = Callable[[Cameras, int], Annotated[Tensor, "H W 3"]]
"""Renders one view at its camera's size."""


class Setting(NamedTuple):
    """One value of one knob."""

    knob: str
    value: str
    draw: Draw

    @property
    def name(self) -> str:
        """Knob and value."""
        return f"{self.knob} {self.value}"


def plain_settings(trained: Trained, styled: Styled) -> Iterator[Setting]:
    """Everything but the style; and the style at strength 0, which must cost nothing and change nothing."""
    yield from _settings(trained, None)
    nothing = replace(styled.restyle, strength=0.0)
    yield Setting("style", "at strength 0", _drawer(trained.model, trained.known.facts, trained.config.render, nothing))


def styled_settings(trained: Trained, styled: Styled, stylizer: StylizerConfig) -> Iterator[Setting]:
    """The same in a style, and how many semantic channels it looks at."""
    yield from _settings(trained, styled.restyle)
    dim = styled.scene.keys.shape[1]
    for channels in sorted({max(1, dim // 8), max(1, dim // 4), max(1, dim // 2)} - {dim}):
        yield Setting("semantic channels", f"{channels} of {dim}", _fewer_channels(trained, styled, stylizer, channels))


def _settings(trained: Trained, look: Restyle | None) -> Iterator[Setting]:
    render = trained.config.render
    model, facts = trained.model, trained.known.facts
    yield Setting("run", "as trained", _drawer(model, facts, render, look))
    for preset in PRESETS:
        chosen = at_quality(trained, QualityConfig(quality=preset))
        yield Setting("quality", preset, _drawer(chosen.model, facts, chosen.config.render, look))
    for name, budget in BUDGETS.items():
        yield Setting("budget", name, _drawer(model, facts, replace(render, budget=budget), look))
    for share in SAMPLES:
        chosen = at_quality(trained, QualityConfig(samples=share))
        yield Setting("samples", f"x {share:g}", _drawer(chosen.model, facts, chosen.config.render, look))
    for chunk in CHUNKS:
        yield Setting("chunk", str(chunk), _drawer(model, facts, replace(render, chunk=chunk), look))
    for size in SIZES:
        yield Setting("resolution", f"x {size:g}", _drawer(model, facts, replace(render, resolution=size), look))
    yield Setting("kernels", "none, plain torch", _plain_drawer(model, facts, render, look, nullcontext))
    yield Setting("kernels", "none, grid_sample", _plain_drawer(model, facts, render, look, lambda: plain_planes(model)))
    stored = half_planes(model)
    yield Setting("precision", "planes stored in float16", _drawer(stored, facts, render, look))
    yield Setting("precision", "plain, bfloat16", _plain_drawer(model, facts, render, look, lambda: half_networks(model)))


def _drawer(model: Model, facts: Facts, render: RenderConfig, look: Restyle | None) -> Draw:
    return lambda cameras, view: render_view(model, facts, cameras, view, render, look).rgb


def _plain_drawer(
    model: Model,
    facts: Facts,
    render: RenderConfig,
    look: Restyle | None,
    around: Callable[[], AbstractContextManager[None]],
) -> Draw:
    def draw(cameras: Cameras, view: int) -> Tensor:
        width, height = (int(v) for v in cameras.size[view])
        with around():
            return plainly(model, facts, view_rays(model, cameras, view), render, look).view(height, width, 3).cpu()

    return draw


@contextmanager
def half_networks(model: Model) -> Iterator[None]:
    """Content, semantics and decoder in bfloat16; planes, density and compositing stay in float32. For `plainly` alone: kernels
    have one precision.
    """
    device = model.device.type

    def around(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            with torch.autocast(device, dtype=torch.bfloat16):
                return method(*args).float()

        return call

    with ExitStack() as stack:
        stack.enter_context(replaced(model.field, "content", around))
        stack.enter_context(replaced(model.decoder, "forward", around))
        stack.enter_context(replaced(model.decoder, "restyled", around))
        if model.semantic is not None:
            stack.enter_context(replaced(model.semantic, "forward", around))
        yield


def half_planes(model: Model) -> Model:
    """A copy whose planes are stored in half precision; kernels for the CPU read float32, so there they are only rounded."""
    made = copy.deepcopy(model).requires_grad_(False)
    for module in made.modules():
        if isinstance(module, Planes):
            half = module.table.half()
            module.table = nn.Parameter(half if half.device.type == "cuda" else half.float(), requires_grad=False)
    return made


class _Leading(SemanticField):
    """The first channels of a semantic field: principal components, most variance first."""

    def __init__(self, field: SemanticField, channels: int) -> None:
        super().__init__()
        self.field, self.channels = field, channels

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Fewer channels of the same features."""
        features: Tensor = self.field(points)
        return features[:, : self.channels]

    def penalties(self) -> dict[str, Tensor]:
        """None: it is not trained."""
        return {}


def _fewer_channels(trained: Trained, styled: Styled, stylizer: StylizerConfig, channels: int) -> Draw:
    parts = trained.model.parts
    assert parts.semantic is not None
    scene = styled.scene._replace(keys=styled.scene.keys[:, :channels], semantic_mean=styled.scene.semantic_mean[:channels])
    origin = None if styled.dictionary.origin is None else styled.dictionary.origin[:channels]
    dictionary = styled.dictionary._replace(keys=styled.dictionary.keys[:, :channels], origin=origin)
    device = trained.model.device
    built = stylizer.build(dictionary=dictionary, scene=scene).to(device)
    model = Model(parts._replace(semantic=_Leading(parts.semantic, channels))).eval()
    look = replace(styled.restyle, stylizer=built)
    return _drawer(model, trained.known.facts, trained.config.render, look)


@dataclass(frozen=True, kw_only=True)
class Point:
    """One setting of one knob, everything else as the run has it."""

    knob: str
    value: str
    seconds: Spread
    """Of a view."""
    rays_per_second: float
    largest: float | None
    """Largest colour error against the exact result; None where there is none to compare with."""
    rms: float | None
    """Root-mean-square colour error against it."""
    psnr: float | None = None
    """Against the photographs, in dB."""

    @property
    def name(self) -> str:
        """Knob and value."""
        return f"{self.knob} {self.value}"

    def json(self) -> dict[str, object]:
        """What is known of it."""
        known: dict[str, object] = {
            "knob": self.knob,
            "value": self.value,
            "milliseconds": 1e3 * self.seconds.median,
            "low": 1e3 * self.seconds.low,
            "high": 1e3 * self.seconds.high,
            "rays_per_second": self.rays_per_second,
            "largest_error": self.largest,
            "rms_error": self.rms,
            "psnr": self.psnr,
        }
        return {
            key: float(f"{value:.5g}") if isinstance(value, float) else value
            for key, value in known.items()
            if value is not None
        }


def front(points: Sequence[Point], error: Callable[[Point], float | None]) -> list[Point]:
    """The points that no other one equals or beats in both time and error, fastest first. Points without error are left out."""
    chosen: list[Point] = []
    best = float("inf")
    known = [(point.seconds.median, away, i) for i, point in enumerate(points) if (away := error(point)) is not None]
    for _, away, i in sorted(known):
        if away < best:
            best = away
            chosen.append(points[i])
    return chosen


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


def pareto(config: ParetoConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """Points and fronts."""
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
    fronts, tables = {}, []
    for name, points in curves.items():
        by_error, by_truth = front(points, lambda p: p.rms), front(points, _loss)
        fronts[name] = {"rms_error": [p.name for p in by_error], "psnr": [p.name for p in by_truth]}
        tables.append(_table(name, points, by_error, by_truth))
    trained = subject.trained
    about = settings(config, trained, missing) | {"view": size_of(camera), "views": config.views}
    extra = {
        "points": {name: [p.json() for p in points] for name, points in curves.items()},
        "fronts": fronts,
        "counters_by_budget": counters,
    }
    made = document("pareto", [], device=trained.model.device, settings=about, extra=extra)
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
