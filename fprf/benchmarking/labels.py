"""Names for the parts of a model that a profiler sees, and what its events say about them.

Forward parts are ranges of time with a name; a range within a range takes its time from the outer one. A backward node is
charged to the part in which the forward operation that made it ran: autograd numbers operations, and the node keeps the
number.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, Protocol

from torch import nn
from torch.profiler import record_function

from ..interfaces import Stylizer
from ..training.model import Model
from .naive import replaced

__all__ = ["PREFIX", "REST", "Event", "Range", "attribute", "exclusive", "labelled"]

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
