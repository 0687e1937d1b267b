"""Knobs of `fprf bench restyle`, `peer` and `paper`. Imports no torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ..checks import at_least, between, positive
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig
from ..style.config import StyleConfig

__all__ = ["EvidenceConfig", "PaperConfig", "PeerConfig", "RestyleConfig"]


@dataclass(frozen=True, kw_only=True)
class EvidenceConfig:
    """What every report shares."""

    output: Path | None = None
    """JSON file for the figures; none = only the table."""
    page: Path | None = None
    """Markdown file for them; none = none."""


@dataclass(frozen=True, kw_only=True)
class RestyleConfig(EvidenceConfig):
    """Restyling judged by the truth: a town in the light of other towns, against itself in that very light."""

    run: Path | None = None
    """Run folder, trained on the embedded town; none = fprf-lite is trained on it first, in a folder that is thrown away."""
    minutes: float = 2.0
    """How long it is trained, where no run is given."""
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


@dataclass(frozen=True, kw_only=True)
class PeerConfig(EvidenceConfig):
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
    """What the depths are: distances along each pixel's ray, or along the camera's axis."""
    run: Path | None = None
    """A run of ours on the same scene: renders the plain frames and depths that are not given."""
    truth: Path | None = None
    """Folder of the true frames, where they are known, by the same names."""
    references: tuple[Path, ...] = ()
    """Photographs that gave the style."""
    device: str = "auto"
    """cpu, cuda, mps, or auto: where a run is rendered."""


@dataclass(frozen=True, kw_only=True)
class PaperConfig(EvidenceConfig):
    """A table of the paper, from short trainings of one scene: the method as it is, and with one thing changed."""

    table: Literal[
        "reconstruction", "ablation", "guided-filter", "time", "multi-reference", "clusters", "statistics", "large-scale"
    ] = "reconstruction"
    """Which."""
    run: Path | None = None
    """Run folder of a town, for the tables that train nothing but one scene; none = that one is trained first."""
    data: Path = Path("town")
    """Scene folder; the embedded town is also restyled, and judged by its truth."""
    references: tuple[Path, ...] = ()
    """Photographs that another scene is restyled by, judged by structure and by VGG-19's statistics; none = not restyled."""
    downscale: int = 1
    """Images at 1/downscale of their size."""
    method: str = "fprf-lite"
    """Method that is changed: its name, or the config.json of a run."""
    steps: int = 400
    """Steps of each training."""
    trainings: tuple[int, ...] = (0,)
    """Seeds: every row is the mean over trainings with these."""
    views: int = 4
    """Held-out views that are judged."""
    palettes: tuple[str, ...] = ("autumn", "night")
    """Lights that a town is restyled in, with three references."""
    clusters: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Style codes per reference, of the table of that name."""
    codes: int = StyleConfig.clusters
    """Style codes per reference, of all others."""
    blend: float = StyleConfig.blend
    """Share of the overall style in each local one, in [0, 1]."""
    device: str = "auto"
    """cpu, cuda, mps, or auto."""

    def __post_init__(self) -> None:
        at_least("downscale", self.downscale, 1)
        at_least("steps", self.steps, 1)
        at_least("trainings", len(self.trainings), 1)
        at_least("views", self.views, 1)
        at_least("palettes", len(self.palettes), 1)
        at_least("codes", self.codes, 1)
        between("blend", self.blend, 0.0, 1.0)
        for value in self.clusters:
            at_least("clusters", value, 1)
