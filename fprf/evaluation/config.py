"""Settings of `fprf bench`. Imports no torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..checks import at_least, between, positive
from ..errors import ConfigError
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig
from ..style.config import StyleConfig

_KINDS = ("sky", "plants", "ground", "houses")


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """Measurements and their repetitions."""

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
class ReportConfig:
    """Fields that every report shares."""

    output: Path | None = None
    """JSON file for the figures; none = only the table."""
    page: Path | None = None
    """Markdown file for them; none = none."""


@dataclass(frozen=True, kw_only=True)
class RestyleConfig(ReportConfig):
    """Restyling judged by the truth: a town in the light of other towns, against itself in that very light."""

    run: Path | None = None
    """Run folder, trained on the embedded town; none = fprf-lite is trained on it first, in a folder that is thrown away."""
    minutes: float = 2.0
    """Training time, where no run is given."""
    palettes: tuple[str, ...] = ("autumn", "winter", "sunset", "night")
    """Lights that are asked for."""
    seeds: tuple[int, ...] = (7, 11, 13)
    """Three other towns, which the references show."""
    views: int = 4
    """Held-out views that are judged."""
    frames: int = 8
    """Frames of the path on which consistency is measured; at least 8, so that there is a pair 7 apart."""
    longest: int = 120
    """Longer side in pixels of views and frames."""
    stylizer: StylizerConfig = RegionToneConfig()
    """The method that is to be recommended."""
    clusters: int = StyleConfig.clusters
    """Style codes per reference, for all methods."""
    blend: float = StyleConfig.blend
    """Share of the overall style in each local one, for all methods, in [0, 1]."""
    missing: tuple[str, ...] = ("sky", "plants", "ground", "houses")
    """Kinds of things that a reference is without, one after the other."""
    sheet: Path | None = None
    """Picture of all methods side by side, .png or .jpg; none = none."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        positive("minutes", self.minutes)
        at_least("views", self.views, 1)
        at_least("frames", self.frames, 8)
        at_least("longest", self.longest, 16)
        at_least("clusters", self.clusters, 1)
        between("blend", self.blend, 0.0, 1.0)
        at_least("palettes", len(self.palettes), 1)
        at_least("seeds", len(self.seeds), 3)
        for kind in self.missing:
            if kind not in _KINDS:
                raise ConfigError(f"missing: {kind!r} is no kind of thing of the town; allowed are {', '.join(_KINDS)}")


@dataclass(frozen=True, kw_only=True)
class PeerConfig(ReportConfig):
    """Stylised frames of any system, scored by the same code; see docs/evidence/protocol.md."""

    frames: Path = Path()
    """Folder of the stylised frames, in the order of their names: a path for consistency."""
    cameras: Path = Path("transforms.json")
    """Their cameras: a transforms.json whose file_path have the frames' stems. Pinholes."""
    plain: Path | None = None
    """Folder of the same frames before they were stylised, by the same names: what consistency is relative to."""
    depth: Path | None = None
    """Folder of NAME.npz (array `depth`) or NAME.npy: [H W], in the unit of the poses; 0 or infinite = nothing there."""
    depth_along: Literal["ray", "axis"] = "ray"
    """Kind of depth: distances along each pixel's ray, or along the camera's axis."""
    run: Path | None = None
    """A run of ours on the same scene: renders the plain frames and depths that are not given."""
    truth: Path | None = None
    """Folder of the true frames, where they are known, by the same names."""
    references: tuple[Path, ...] = ()
    """Photographs that gave the style."""
    device: str = "auto"
    """cpu, cuda, mps, or auto: where a run is rendered."""
