"""Points of time against error, and which of them nothing beats. Both axes: less is better."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .timing import Spread

__all__ = ["Point", "front"]


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
