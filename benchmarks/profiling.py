"""Profile: where the time of a training step, of a render chunk and of a restyled one goes, by named part.

Shares are from profiled calls, milliseconds of the whole from calls without the profiler, which costs a few percent. On a
GPU the times are those in which the host was busy. Parts are named ranges of time; a range within a range takes its time from
the outer one. The backward pass is one part.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn
from torch.autograd.profiler import profile as recording
from torch.profiler import record_function

from fprf.checks import at_least
from fprf.interfaces import Stylizer
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.rendering.renderer import render_rays
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.training.model import Model, background_of
from fprf.types import Rays, Want

from .common import BenchConfig, Progress, bench_run
from .report import Outcome, Watch, document, table
from .speed import replaced
from .subject import attempt, find, fresh_model, loop_of, settings, stepper, test_view, view_rays, watch_of


@dataclass(frozen=True, kw_only=True)
class ProfileConfig(BenchConfig):
    """Where the time of a training step and of a render chunk goes."""

    operators: int = 0
    """Also list so many of the most expensive torch operators."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("operators", self.operators, 0)


PREFIX = "fprf."
REST = "rest"
"""What no name covers."""


class Range(NamedTuple):
    """A named stretch of time, in microseconds."""

    name: str
    start: float
    end: float


@contextmanager
def labelled(model: Model, stylizer: Stylizer | None = None) -> Iterator[None]:
    """Every part of the model carries its name while this lasts."""
    named: list[tuple[nn.Module | None, str, str]] = [
        (model.sampler, "forward", "sampler"),
        (model.field, "density", "density"),
        (model.field, "content", "content"),
        (model.semantic, "forward", "semantic"),
        (model.decoder, "forward", "decoder"),
        (model, "penalties", "penalties"),
        (stylizer, "shared", "stylizer"),
    ]

    def around(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        return lambda method: record_function(PREFIX + name)(method)

    with ExitStack() as stack:
        for module, method, name in named:
            if module is not None:
                stack.enter_context(replaced(module, method, around(name)))
        yield


def exclusive(ranges: Sequence[Range]) -> dict[str, float]:
    """Microseconds of each name, without those of the ranges within. Ranges lie in or beside each other."""
    spent: dict[str, float] = {}
    open_: list[Range] = []
    for part in sorted(ranges, key=lambda r: (r.start, -r.end)):
        while open_ and open_[-1].end <= part.start:
            open_.pop()
        length = part.end - part.start
        spent[part.name] = spent.get(part.name, 0.0) + length
        if open_:
            spent[open_[-1].name] -= length
        open_.append(part)
    return spent


def take_apart(call: Callable[[], object], watch: Watch, operators: int) -> dict[str, Any]:
    """Milliseconds of a call without the profiler; shares of its parts and of the most expensive operators with it."""
    whole = watch.spread(call)
    with recording(use_device="cuda" if watch.device.type == "cuda" else None) as recorder:
        for _ in range(watch.rounds):
            call()
    events = sorted(recorder.function_events or (), key=lambda e: e.time_range.start)
    ranges = [
        Range(event.name.removeprefix(PREFIX), event.time_range.start, event.time_range.end)
        for event in events
        if event.name.startswith(PREFIX)
    ]
    # Microseconds in which some event was under way: what lies between calls does not count.
    total, end = 0.0, float("-inf")
    for event in events:
        total += max(0.0, event.time_range.end - max(end, event.time_range.start))
        end = max(end, event.time_range.end)
    spent = exclusive(ranges)
    spent[REST] = total - sum(spent.values())
    averages = recorder.key_averages() if operators else []
    most = sorted((e for e in averages if not e.key.startswith(PREFIX)), key=lambda e: -e.self_cpu_time_total)[:operators]
    milliseconds = 1e3 * whole.median
    parts = sorted(spent.items(), key=lambda part: -part[1])
    return {
        "milliseconds": milliseconds,
        "low": 1e3 * whole.low,
        "high": 1e3 * whole.high,
        "parts": {name: {"share": taken / total, "milliseconds": taken / total * milliseconds} for name, taken in parts},
        "operators": {e.key: {"share": e.self_cpu_time_total / total} for e in most},
    }


def profile(config: ProfileConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """A training step, a plain chunk and a restyled one."""
    subject = find(root, config, folder)
    trained, device = subject.trained, subject.trained.model.device
    watch = watch_of(config, trained)
    found: dict[str, dict[str, Any]] = {}
    progress(0, 3, "training")
    prepared, missing = attempt(subject)
    if prepared is not None:
        loop = loop_of(trained.config, prepared, fresh_model(trained))
        with labelled(loop.model):
            found["training step"] = take_apart(stepper(loop, trained.step), watch, config.operators)
    progress(1, 3, "rendering")
    render = trained.config.render
    rays = Rays(*(x[: render.chunk] for x in view_rays(trained.model, test_view(config, trained), 0)))
    look = apply_style(trained, StyleFile(StyleConfig(references=subject.references, stylizer=RegionOtConfig()))).restyle
    background = background_of(trained.known.facts, device)
    for name, style in (("render", None), ("stylised render, region-ot", look)):

        @torch.inference_mode()
        def draw(style: Restyle | None = style) -> None:
            render_rays(rays, trained.model.parts, want=Want.COLOUR, budget=render.budget, background=background, restyle=style)

        with labelled(trained.model, look.stylizer):
            found[f"{name} of {len(rays.near)} rays"] = take_apart(draw, watch, config.operators)
        progress(2, 3, "restyling")
    made = document("profile", [], device=device, settings=settings(config, trained, missing), extra={"parts": found})
    tables = []
    for name, parts in found.items():
        rows = [(part, f"{100 * p['share']:.1f}", f"{p['milliseconds']:.2f}") for part, p in parts["parts"].items()]
        rows += [(f"operator {op}", f"{100 * p['share']:.1f}", "") for op, p in parts["operators"].items()]
        tables.append(table(name, ("part", "%", "ms"), [*rows, ("whole", "100", f"{parts['milliseconds']:.2f}")]))
    return Outcome(made, tables)


def main(argv: list[str]) -> int:
    """`python -m benchmarks profiling [RUN] [flags]`."""
    return bench_run("python -m benchmarks profiling", ProfileConfig(), argv, profile)
