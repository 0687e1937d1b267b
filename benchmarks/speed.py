"""Ours against the naive path, on the same model in the same run, with the error beside each time.

The naive path: plain torch for the planes, every sample through every network, every term at every step.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fprf.checks import at_least
from fprf.config import RenderConfig, TrainConfig
from fprf.fields.planes import Planes
from fprf.interfaces import Stylizer
from fprf.ops import backend, triplane
from fprf.plugins import slots
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionOtConfig, RegionToneConfig, StylizerConfig
from fprf.rendering.cameras import Cameras
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.training.facts import Facts
from fprf.training.field_scene import Trained
from fprf.training.field_setup import Prepared
from fprf.training.model import Model
from fprf.training.views import cache_view, render_view

from .common import BenchConfig, bench_run
from .report import Outcome, Row, document, ratio, rows_table, spread
from .subject import (
    Subject,
    attempt,
    batch_rays,
    colour_gradient,
    count,
    difference,
    exact,
    find,
    fresh_model,
    loop_of,
    plainly,
    settings,
    size_of,
    small_view,
    stepper,
    test_view,
    view_rays,
    watch_of,
)


@dataclass(frozen=True, kw_only=True)
class SpeedConfig(BenchConfig):
    """Ours against the naive path, in one run."""

    points: int = 65536
    """Points of the tri-plane lookup."""
    clusters: int = StyleConfig.clusters
    """Local styles per reference."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("points", self.points, 1)
        at_least("clusters", self.clusters, 1)


def grid_sample_lookup(
    points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> Annotated[Tensor, "N scales*F"]:
    """`triplane.lookup` by twelve calls of torch's grid_sample, as K-Planes has it."""
    scales = []
    for planes in triplane.split(table, resolutions):
        product: Tensor | None = None
        for plane, (a, b) in zip(planes, triplane.AXES, strict=True):
            at = torch.stack([points[:, a], points[:, b]], -1)[None, None]
            value = F.grid_sample(
                plane.permute(2, 0, 1)[None], at, align_corners=True, padding_mode="border"
            )[0, :, 0].T
            product = value if product is None else product * value
        assert product is not None
        scales.append(product)
    return torch.cat(scales, -1)


@contextmanager
def replaced(
    module: nn.Module, name: str, around: Callable[[Callable[..., Any]], Callable[..., Any]]
) -> Iterator[None]:
    """A method of one module wrapped for a while; its class, and every other module, stay as they are."""
    setattr(module, name, around(getattr(module, name)))
    try:
        yield
    finally:
        delattr(module, name)


@contextmanager
def plain_planes(*models: nn.Module) -> Iterator[None]:
    """No compiled kernels at all: grid_sample for lookups, slices for total variation."""
    with backend.plain(), ExitStack() as stack:
        for model in models:
            for module in model.modules():
                if isinstance(module, Planes):
                    stack.enter_context(replaced(module, "forward", _looked_up(module)))
                    stack.enter_context(replaced(module, "variation", _varied(module)))
        yield


def without_skipping(config: TrainConfig) -> TrainConfig:
    """The same training with nothing left out: every sample, every ray's semantics, every term at every
    step.
    """
    if any(field.name == "semantic_share" for field in fields(config.datamanager)):
        config = slots.replace(config, "datamanager.semantic_share", 1.0)
    return replace(
        config,
        render=replace(config.render, budget=0.0, train_budget=0.0),
        semantic=replace(config.semantic, samples=10**6),
        loss=replace(config.loss, penalty_every=1),
    )


def _looked_up(planes: Planes) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return lambda ours: lambda points: grid_sample_lookup(points, planes.table, planes.resolutions)


def _varied(planes: Planes) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    return lambda ours: lambda: triplane.variation_reference(planes.table, planes.resolutions)


Lookup = Callable[[Tensor, Tensor, Sequence[int]], Tensor]
FORMS: dict[str, Lookup] = {
    "ours": triplane.lookup,
    "grid_sample": grid_sample_lookup,
    "reference": triplane.lookup_reference,
}
GOAL = 8.0
"""Times faster than grid_sample, on a CPU."""


def triplane_rows(config: SpeedConfig, trained: Trained) -> list[Row]:
    """Milliseconds of forward and backward together, on the largest planes of the model."""
    planes = largest_planes(trained.model)
    device = trained.model.device
    if planes is None:
        return []
    points = draw_points(config.points, config.seed, device)
    table = planes.table.detach().clone()
    calls = {
        name: partial(forward_backward, form, points, table, planes.resolutions)
        for name, form in FORMS.items()
    }
    seconds = watch_of(config, trained).in_turn(calls)
    truth = forward_backward(triplane.lookup_reference, points.double(), table.double(), planes.resolutions)
    rows = []
    for peer in ("grid_sample", "reference"):
        rows.append(
            replace(
                _compared(
                    f"tri-plane forward + backward, against {peer}",
                    "ms",
                    _milliseconds,
                    seconds["ours"],
                    seconds[peer],
                ),
                ratio_goal=GOAL if peer == "grid_sample" and device.type == "cpu" else None,
                error=_error(calls["ours"](), truth),
                error_kind="largest error of value or gradient against float64, relative to the largest of each",
                peer_error=_error(calls[peer](), truth),
                note=f"{config.points} points, planes of {', '.join(map(str, planes.resolutions))}, {table.shape[1]} channels",
            )
        )
    return rows


def forward_backward(
    lookup: Lookup,
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
) -> tuple[Tensor, Tensor]:
    """Values, and the table's gradient of half the sum of their squares."""
    leaf = table.detach().requires_grad_()
    values = lookup(points, leaf, resolutions)
    (gradient,) = torch.autograd.grad(values, leaf, values.detach())
    return values.detach(), gradient


def largest_planes(model: torch.nn.Module) -> Planes | None:
    """The tri-planes with the most numbers, if the model has any."""
    planes = [module for module in model.modules() if isinstance(module, Planes)]
    return max(planes, key=lambda each: each.table.numel(), default=None)


def draw_points(count: int, seed: int, device: torch.device) -> Annotated[Tensor, "count 3"]:
    """Points of the unit cube, evenly spread."""
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, generator=generator) * 2 - 1).to(device)


def _error(computed: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor]) -> float:
    return max(
        float((a.double() - b).abs().max() / b.abs().max().clamp_min(1e-30))
        for a, b in zip(computed, truth, strict=True)
    )


CACHED = 135 * 240
"""Pixels of a cached view, where the run's views have so many."""
_FAST = 90.0
"""Milliseconds for a new style on that many pixels."""


def cached_rows(config: SpeedConfig, subject: Subject, styles: dict[str, StylizerConfig]) -> list[Row]:
    """A cached view in each style, beside rendering it anew."""
    trained = subject.trained
    known = trained.known
    render = trained.config.render
    camera = small_view(known.cameras, (known.test or known.train)[0], CACHED)
    whole = int(camera.size[0].prod()) > 0.9 * CACHED
    view = cache_view(trained.model, known.facts, camera, 0, render)
    looks = {
        name: apply_style(
            trained,
            StyleFile(StyleConfig(references=subject.references, stylizer=s, clusters=config.clusters)),
        ).restyle
        for name, s in styles.items()
    }
    calls: dict[str, Callable[[], Tensor]] = {}
    for name, look in looks.items():
        calls[name] = lambda look=look: view.restyled(look).rgb  # type: ignore[misc]
        calls[f"anew {name}"] = partial(_drawn, trained.model, known.facts, camera, render, look)
    seconds = watch_of(config, trained).in_turn(calls)
    rows = []
    for name in looks:
        rows.append(
            replace(
                _compared(
                    f"cached view restyled, {name}",
                    "ms",
                    _milliseconds,
                    seconds[name],
                    seconds[f"anew {name}"],
                ),
                goal=_FAST if whole else None,
                error=difference(calls[name](), calls[f"anew {name}"]()).largest,
                error_kind="largest colour difference from the view rendered anew",
                note=size_of(camera),
            )
        )
    return rows


def _milliseconds(seconds: float) -> float:
    return 1e3 * seconds


def _compared(
    name: str, unit: str, figure: Callable[[float], float], own: Sequence[float], peer: Sequence[float]
) -> Row:
    """A monotonic figure of the seconds of each round, beside that of a peer."""
    ours = spread(own).map(figure)
    theirs = figure(spread(peer).median)
    return Row(
        name=name,
        figure=ours.median,
        low=ours.low,
        high=ours.high,
        unit=unit,
        peer=theirs,
        ratio=ratio(peer, own),
    )


Progress = Callable[[int, int, str], None]
STYLES: dict[str, StylizerConfig] = {
    "region-tone": RegionToneConfig(),
    "region-ot": RegionOtConfig(),
    "local-adain": LocalAdainConfig(),
}
"""The recommended stylizer, that which costs most, and the paper's."""
_TRAINED = 6.0
"""Times faster than the naive path: a training step, on a CPU."""
_DRAWN = 4.0
"""The same of a view, plain or in a style."""
BUDGET = 1 / 512
"""The error that skipping may cost: half an 8-bit step."""


def speed(config: SpeedConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """Training, rendering, restyling, tri-planes."""
    subject = find(root, config, folder)
    rows: list[Row] = []
    progress(0, 5, "training")
    prepared, missing = attempt(subject)
    if prepared is not None:
        rows.append(_training(config, subject, prepared))
    progress(1, 5, "rendering")
    drawn, counters = _rendering(config, subject)
    rows += drawn
    progress(2, 5, "restyling")
    rows += _restyling(config, subject)
    progress(3, 5, "reuse")
    rows += cached_rows(config, subject, STYLES)
    progress(4, 5, "tri-planes")
    rows += triplane_rows(config, subject.trained)
    progress(5, 5, "done")
    trained = subject.trained
    about = settings(config, trained, missing) | {
        "view": size_of(test_view(config, trained)),
        "points": config.points,
    }
    made = document("speed", rows, device=trained.model.device, settings=about, extra={"counters": counters})
    return Outcome(made, [rows_table("speed, beside the naive path", rows)])


def _training(config: SpeedConfig, subject: Subject, prepared: Prepared) -> Row:
    trained = subject.trained
    plain = without_skipping(trained.config)
    ours = loop_of(trained.config, prepared, fresh_model(trained))
    naive = loop_of(plain, subject.prepare(plain), fresh_model(trained))
    take = stepper(ours, trained.step)
    walk = stepper(naive, trained.step)

    def naively() -> None:
        with plain_planes(naive.model):
            walk()

    seconds = watch_of(config, trained).in_turn({"ours": take, "naive": naively})
    rays = len(ours.manager.batch(trained.step).rgb)
    naive_rays = len(naive.manager.batch(0).rgb)
    row = _compared("train", "rays/s", lambda s: rays / s, seconds["ours"], seconds["naive"])
    return replace(
        row,
        peer=naive_rays / spread(seconds["naive"]).median,
        ratio_goal=_TRAINED if trained.model.device.type == "cpu" else None,
        error=_gradient_error(subject, prepared),
        error_kind="relative L2 error of the colour loss's gradient against float64 without skipping",
    )


def _gradient_error(subject: Subject, prepared: Prepared) -> float:
    trained = subject.trained
    batch = prepared.manager.batch(trained.step)
    model = fresh_model(trained)
    rays = batch_rays(model, prepared, batch)
    ours = colour_gradient(model, prepared, trained.config, batch, rays, trained.step).double()
    wide = fresh_model(trained).double()
    rays = type(rays)(*(x.double() for x in rays))
    truth = colour_gradient(wide, prepared, without_skipping(trained.config), batch, rays, trained.step)
    return float((ours - truth).norm() / truth.norm().clamp_min(1e-30))


def _rendering(config: SpeedConfig, subject: Subject) -> tuple[list[Row], dict[str, float]]:
    trained = subject.trained
    camera = test_view(config, subject.trained)
    pixels = int(camera.size[0].prod())
    looks: dict[str, Restyle | None] = {"render": None}
    for name, stylizer in STYLES.items():
        made = apply_style(
            trained,
            StyleFile(
                StyleConfig(references=subject.references, stylizer=stylizer, clusters=config.clusters)
            ),
        )
        looks[f"stylised, {name}"] = made.restyle
    model = trained.model
    facts = trained.known.facts
    render = trained.config.render
    rays = view_rays(model, camera, 0)
    calls: dict[str, Callable[[], Tensor]] = {}
    for name, look in looks.items():
        calls[name] = partial(_drawn, model, facts, camera, render, look)
        calls[f"naive {name}"] = partial(_naively, model, facts, camera, replace(render, budget=0.0), look)
    seconds = watch_of(config, trained).in_turn(calls)
    rows = []
    for name, look in looks.items():
        truth = exact(model, facts, rays, look).cpu()
        rows.append(
            replace(
                _compared(name, "rays/s", lambda s: pixels / s, seconds[name], seconds[f"naive {name}"]),
                ratio_goal=_DRAWN if render.budget == BUDGET else None,
                error=difference(calls[name](), truth).largest,
                error_kind="largest colour error against float64 without skipping",
                peer_error=difference(calls[f"naive {name}"](), truth).largest,
            )
        )
    return rows, count(model.parts, rays, render.budget)


def _drawn(model: Model, facts: Facts, camera: Cameras, render: RenderConfig, look: Restyle | None) -> Tensor:
    return render_view(model, facts, camera, 0, render, look).rgb


def _naively(
    model: Model, facts: Facts, camera: Cameras, render: RenderConfig, look: Restyle | None
) -> Tensor:
    with plain_planes(model):
        return plainly(model, facts, view_rays(model, camera, 0), render, look).cpu()


def _restyling(config: SpeedConfig, subject: Subject) -> list[Row]:
    """A new photograph: to its dictionary, to the first picture."""
    trained = subject.trained
    camera = test_view(config, subject.trained)
    made: dict[str, Stylizer] = {}

    def dictionary() -> None:
        made["new"] = apply_style(
            trained,
            StyleFile(
                StyleConfig(
                    references=subject.references[:1], stylizer=RegionOtConfig(), clusters=config.clusters
                )
            ),
        ).restyle.stylizer

    def first() -> None:
        dictionary()
        render_view(
            trained.model, trained.known.facts, camera, 0, trained.config.render, Restyle(made["new"])
        )

    seconds = watch_of(config, trained).in_turn({"dictionary": dictionary, "first": first})
    rows = []
    for name, label, goal in (
        ("dictionary", "new reference to its dictionary", 1.0),
        ("first", "new reference to the first view", 2.0),
    ):
        taken = spread(seconds[name])
        rows.append(Row(name=label, figure=taken.median, low=taken.low, high=taken.high, unit="s", goal=goal))
    return rows


def main(argv: list[str]) -> int:
    """`python -m benchmarks speed [RUN]`."""
    return bench_run("python -m benchmarks speed", SpeedConfig(), argv, speed)
