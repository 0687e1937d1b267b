"""Times that can be compared on a busy machine: what is compared runs in turn, round after round, and ratios are taken
within a round. Reported are the median and the quartiles over the rounds; one call of each before them does not count.
"""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import torch

__all__ = ["Clock", "Spread", "Watch", "ratio", "spread"]

Clock = Literal["wall", "processor"]


class Spread(NamedTuple):
    """A figure over the rounds."""

    median: float
    low: float
    """First quartile."""
    high: float
    """Third quartile."""
    rounds: int

    def map(self, function: Callable[[float], float]) -> "Spread":
        """The spread of a monotonic function of the figure."""
        low, high = sorted((function(self.low), function(self.high)))
        return Spread(function(self.median), low, high, self.rounds)


def spread(values: Sequence[float]) -> Spread:
    """Median and quartiles, inclusive: of two values they lie between, of one they are the value."""
    if len(values) < 2:
        return Spread(values[0], values[0], values[0], 1)
    low, median, high = statistics.quantiles(values, n=4, method="inclusive")
    return Spread(median, low, high, len(values))


class Watch(NamedTuple):
    """How times are taken."""

    rounds: int
    device: torch.device
    clock: Clock = "wall"

    def once(self, call: Callable[[], object]) -> float:
        """Seconds of one call, until the device has finished; a processor's clock says nothing of another device's time."""
        now = time.process_time if self.clock == "processor" and self.device.type == "cpu" else time.perf_counter
        self._wait()
        start = now()
        call()
        self._wait()
        return now() - start

    def in_turn(
        self,
        calls: Mapping[str, Callable[[], object]],
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> dict[str, list[float]]:
        """Seconds of every call in every round. The order turns by one a round: no call always follows the same."""
        names = list(calls)
        seconds: dict[str, list[float]] = {name: [] for name in names}
        for call in calls.values():
            self.once(call)
        for turn in range(self.rounds):
            progress(turn, self.rounds)
            first = turn % len(names)
            for name in names[first:] + names[:first]:
                seconds[name].append(self.once(calls[name]))
        progress(self.rounds, self.rounds)
        return seconds

    def spread(self, call: Callable[[], object]) -> Spread:
        """Of one call alone."""
        return spread(self.in_turn({"": call})[""])

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        elif self.device.type == "mps":
            torch.mps.synchronize()


def ratio(slow: Sequence[float], fast: Sequence[float]) -> Spread:
    """How many times faster, round by round: load that both met in a round cancels."""
    return spread([a / max(b, 1e-12) for a, b in zip(slow, fast, strict=True)])
