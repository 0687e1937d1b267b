"""Knobs of `fprf bench`. Imports no torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..checks import at_least, positive
from ..style.config import StyleConfig

__all__ = ["BenchConfig", "MemoryConfig", "ParetoConfig", "ProfileConfig", "ScalingConfig", "SpeedConfig", "StressConfig"]


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is measured, and how often."""

    run: Path | None = None
    """Run folder; none = --method is trained on --data for --steps first, in a folder that is thrown away."""
    data: Path | None = None
    """Scene folder, where it has moved since training; without a run the one to train on (none = the embedded town)."""
    method: str = "fprf-lite"
    """Method to train where no run is given."""
    steps: int = 300
    """Steps to train it."""
    references: tuple[Path, ...] = ()
    """Photographs for styles; none = pictures of other towns."""
    repeats: int = 5
    """Rounds: in each one everything that is compared runs once, in turn. Medians and quartiles are over them."""
    rays: int = 8192
    """Rays of a timed view at most: larger views are measured at a smaller size."""
    clock: Literal["wall", "processor"] = "wall"
    """wall, or processor: seconds that this process kept processors busy, all threads together, which other programs on the
    machine hardly disturb. On the CPU alone."""
    seed: int = 0
    """Draws of points and batches."""
    output: Path | None = None
    """JSON file for the figures; none = only the table."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        at_least("steps", self.steps, 1)
        at_least("repeats", self.repeats, 1)
        at_least("rays", self.rays, 64)
        at_least("seed", self.seed, 0)


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


@dataclass(frozen=True, kw_only=True)
class ProfileConfig(BenchConfig):
    """Where the time of a training step and of a render chunk goes."""

    operators: int = 0
    """Also list so many of the most expensive torch operators."""

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least("operators", self.operators, 0)


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


@dataclass(frozen=True, kw_only=True)
class MemoryConfig(BenchConfig):
    """Most memory that each part of the work holds, each in a process of its own."""


@dataclass(frozen=True, kw_only=True)
class ScalingConfig(BenchConfig):
    """Cost against the number of images, pixels, references and points."""

    images: tuple[int, ...] = (2, 4, 8)
    """Training images, where the scene has so many; their features are extracted anew."""
    downscales: tuple[float, ...] = (4.0, 2.0, 1.0)
    """Sizes of the rendered view, relative to the run's."""
    styles: tuple[int, ...] = (1, 2, 4, 8)
    """References of a style; the given ones are taken again and again."""
    points: tuple[int, ...] = (4096, 16384, 65536)
    """Points of a tri-plane lookup, forward and backward."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("images", "downscales", "styles", "points"):
            for value in getattr(self, name):
                at_least(name, value, 1)


@dataclass(frozen=True, kw_only=True)
class StressConfig(BenchConfig):
    """Every stage on adversarial inputs, each against a reference and a bound."""

    steps: int = 60
    """Steps to train it."""
    mutations: int = 200
    """Mutated files for each reader."""
    flips: int = 200
    """Flipped bits in a file of tensors."""
    markdown: Path | None = None
    """The rows as a Markdown table; none = don't."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("mutations", "flips"):
            at_least(name, getattr(self, name), 1)
