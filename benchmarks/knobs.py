"""What can be turned when a scene is trained: the method once as it is, then once with each knob changed, equally long."""

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
from torch import Tensor, nn

from fprf.config import RenderConfig, TrainConfig
from fprf.errors import ConfigError
from fprf.evaluation.metrics import psnr
from fprf.fields.planes import Planes
from fprf.interfaces import SemanticField
from fprf.plugins import slots
from fprf.plugins.stylizers.config import StylizerConfig
from fprf.rendering.cameras import Cameras
from fprf.style.look import Restyle
from fprf.style.restyle import Styled
from fprf.training.driver import Report, learn, schedule_of
from fprf.training.learner import FieldLearner
from fprf.training.loading import Trained
from fprf.training.model import Facts, Model
from fprf.training.quality import PRESETS, QualityConfig, at_quality
from fprf.training.run import Run
from fprf.training.views import render_view

from .report import Spread, Watch, spread
from .speed import plain_planes, replaced
from .subject import Subject, difference, plainly, view_rays

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


def as_rendered(knob: str, value: str, trained: Trained) -> Setting:
    """A run as its own config renders it."""
    return Setting(knob, value, _drawer(trained.model, trained.known.facts, trained.config.render, None))


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
    train_seconds: float | None = None
    """What training took, where the setting was trained."""

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
            "train_seconds": self.train_seconds,
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
        learner = FieldLearner(variant, prepared, subject.trained.device)
        learn(learner, run, schedule_of(variant, len(prepared.scene.train)), last.append)
        model = learner.model.requires_grad_(False).eval()
        trained = replace(subject.trained, config=variant, model=model)
        (point,) = measure([as_rendered("trained", f"{name} ({last[-1].step} steps)", trained)], scenes, watch)
        found.append(replace(point, train_seconds=last[-1].seconds))
    progress(len(chosen), len(chosen), "training variants")
    return found
