"""Profile: where the time of a training step, of a render chunk and of a restyled one goes, by named part.

Shares are from profiled calls, milliseconds of the whole from calls without the profiler, which costs a few percent. On a
GPU the times are those in which the host was busy.

Forward parts are named ranges of time; a range within a range takes its time from the outer one. A backward node is charged to
the part in which its forward operation ran: autograd numbers operations, and the node keeps the number.
"""

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from rich.table import Table
from torch import nn
from torch.autograd.profiler import profile as recording
from torch.profiler import record_function

from fprf.checks import at_least
from fprf.interfaces import Stylizer
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.rendering.renderer import render_rays
from fprf.style.restyle import restyle
from fprf.training.model import Model, background_of
from fprf.types import Rays, Want

from .common import BenchConfig, bench_run
from .report import Outcome, Spread, Watch, document, table
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
_BACKWARD = "autograd::engine::evaluate_function: "
_FORWARD = 0
"""Scope of an operation; that of a backward node is 1."""


class Event(Protocol):
    """What is read of a profiler's event."""

    name: str
    sequence_nr: int
    """Number of the operation that autograd recorded; -1 = none."""
    scope: int
    time_range: Any


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
        (model.decoder, "restyled", "decoder"),
        (model, "penalties", "penalties"),
        (stylizer, "shared", "stylizer"),
    ]
    with ExitStack() as stack:
        for module, method, name in named:
            if module is not None:
                stack.enter_context(replaced(module, method, _named(name)))
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


def attribute(events: Iterable[Event], ranges: Sequence[Range]) -> dict[str, float]:
    """Microseconds of the backward pass by the part whose forward it belongs to; `REST` is for what none owns."""
    born: dict[int, float] = {}
    spent: dict[str, float] = {}
    for event in sorted(events, key=lambda e: e.time_range.start):
        if event.name.startswith(_BACKWARD):
            at = born.get(event.sequence_nr)
            name = REST if at is None else _innermost(at, ranges)
            spent[name] = spent.get(name, 0.0) + event.time_range.end - event.time_range.start
        elif event.scope == _FORWARD and event.sequence_nr >= 0:
            # Operations without a gradient show the number that comes next: the last one to show it has it.
            born[event.sequence_nr] = event.time_range.start
    return spent


def _named(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    def around(method: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            with record_function(PREFIX + name):
                return method(*args, **kwargs)

        return call

    return around


def _innermost(at: float, ranges: Sequence[Range]) -> str:
    around = [part for part in ranges if part.start <= at < part.end]
    return min(around, key=lambda part: part.end - part.start).name if around else REST


Progress = Callable[[int, int, str], None]
BACKWARD = "backward"
ORDER = (
    "batch", "sampler", "density", "content", "semantic", "stylizer", "decoder", "losses", "penalties", BACKWARD, "optimizer",
)  # fmt: skip
"""Parts as a step meets them."""


class Parts(NamedTuple):
    """Where the time of one call goes."""

    whole: Spread
    """Seconds of a call without the profiler."""
    shares: dict[str, float]
    """Of the profiled time, by part; sums to 1. `backward of X` is the backward pass of X."""
    operators: dict[str, float]
    """Share of the profiled time in the most expensive torch operators, themselves alone."""


def profile(config: ProfileConfig, root: Path, folder: Path, progress: Progress) -> Outcome:
    """A training step, a plain chunk and a restyled one."""
    subject = find(root, config, folder)
    trained, device = subject.trained, subject.trained.model.device
    watch = watch_of(config, trained)
    found: dict[str, Parts] = {}
    progress(0, 3, "training")
    prepared, missing = attempt(subject)
    if prepared is not None:
        loop = loop_of(trained.config, prepared, fresh_model(trained))
        with labelled(loop.model):
            found["training step"] = take_apart(stepper(loop, trained.step), watch, config.operators)
    progress(1, 3, "rendering")
    known, render = trained.known, trained.config.render
    rays = view_rays(trained.model, test_view(config, trained), 0)
    rays = Rays(*(x[: render.chunk] for x in rays))
    look = restyle(trained, subject.references, RegionOtConfig()).restyle
    background = background_of(known.facts, device)
    for name, style in (("render", None), ("stylised render, region-ot", look)):

        @torch.inference_mode()
        def draw(style: Any = style) -> None:
            render_rays(rays, trained.model.parts, want=Want.COLOUR, budget=render.budget, background=background, restyle=style)

        with labelled(trained.model, look.stylizer):
            found[f"{name} of {len(rays.near)} rays"] = take_apart(draw, watch, config.operators)
        progress(2, 3, "restyling")
    extra = {"parts": {name: _json(parts) for name, parts in found.items()}}
    made = document("profile", [], device=device, settings=settings(config, trained, missing), extra=extra)
    return Outcome(made, [_table(name, parts) for name, parts in found.items()])


def take_apart(call: Callable[[], object], watch: Watch, operators: int = 0) -> Parts:
    """Time a call without the profiler, then as often with it; and list so many of the most expensive operators."""
    whole = watch.spread(call)
    with _recorded(watch.device) as recorder:
        for _ in range(watch.rounds):
            call()
    events = list(recorder.function_events or ())
    ranges = [
        Range(event.name.removeprefix(PREFIX), event.time_range.start, event.time_range.end)
        for event in events
        if event.name.startswith(PREFIX)
    ]
    spent = exclusive(ranges)
    whole_backward = spent.pop(BACKWARD, 0.0)
    backward = attribute(events, [part for part in ranges if part.name != BACKWARD])
    if whole_backward:
        backward[REST] = whole_backward - sum(taken for name, taken in backward.items() if name != REST)
        spent |= {f"{BACKWARD} of {name}": taken for name, taken in backward.items()}
    total = _total(events)
    spent[REST] = total - sum(spent.values())
    shares = {name: microseconds / total for name, microseconds in _ordered(spent).items()}
    return Parts(whole, shares, _operators(recorder, operators, total))


@contextmanager
def _recorded(device: torch.device) -> Iterator[recording]:
    recorder = recording(use_device="cuda" if device.type == "cuda" else None)
    with _hushed():
        recorder.__enter__()  # type: ignore[no-untyped-call]
    try:
        yield recorder
    finally:
        with _hushed():
            recorder.__exit__(None, None, None)  # type: ignore[no-untyped-call]


@contextmanager
def _hushed() -> Iterator[None]:
    """The profiler's library announces itself on standard error, where our progress lines are JSON."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _total(events: list[Any]) -> float:
    """Microseconds in which some event was under way: what lies between calls does not count."""
    total, end = 0.0, float("-inf")
    for event in sorted(events, key=lambda e: e.time_range.start):
        total += max(0.0, event.time_range.end - max(end, event.time_range.start))
        end = max(end, event.time_range.end)
    return total


def _ordered(spent: dict[str, float]) -> dict[str, float]:
    """In the order of a step, each part's backward after all forward parts; the rest last."""
    places = {name: place for place, name in enumerate(ORDER)}
    own = sorted((n for n in spent if n in places), key=places.__getitem__)
    backward = sorted((n for n in spent if n.startswith(f"{BACKWARD} of ")), key=lambda n: -spent[n])
    other = [n for n in spent if n not in places and n not in backward and n != REST]
    after = [n for n in own if places[n] > places[BACKWARD]]
    return {n: spent[n] for n in [*(n for n in own if n not in after), *other, *backward, *after, REST]}


def _operators(recorder: recording, count: int, total: float) -> dict[str, float]:
    if not count:
        return {}
    averages = recorder.key_averages()  # type: ignore[no-untyped-call]
    most = sorted((e for e in averages if not e.key.startswith(PREFIX)), key=lambda e: -e.self_cpu_time_total)[:count]
    return {e.key: e.self_cpu_time_total / total for e in most}


def _json(parts: Parts) -> dict[str, object]:
    milliseconds = 1e3 * parts.whole.median
    return {
        "milliseconds": milliseconds,
        "low": 1e3 * parts.whole.low,
        "high": 1e3 * parts.whole.high,
        "parts": {name: {"share": share, "milliseconds": share * milliseconds} for name, share in parts.shares.items()},
        "operators": {name: {"share": share} for name, share in parts.operators.items()},
    }


def _table(name: str, parts: Parts) -> Table:
    milliseconds = 1e3 * parts.whole.median
    rows = [(part, f"{100 * share:.1f}", f"{share * milliseconds:.2f}") for part, share in parts.shares.items()]
    rows += [(f"operator {op}", f"{100 * share:.1f}", f"{share * milliseconds:.2f}") for op, share in parts.operators.items()]
    rows.append(("whole", "100", f"{milliseconds:.2f}"))
    return table(name, ("part", "%", "ms"), rows)


def main(argv: list[str]) -> int:
    """`python -m benchmarks profiling [RUN] [flags]`."""
    return bench_run("python -m benchmarks profiling", ProfileConfig(), argv, profile)
