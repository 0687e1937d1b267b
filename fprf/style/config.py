"""Everything that makes a style, as one config: the flags of `fprf stylize` and the content of a `style.json`. No torch."""

from dataclasses import dataclass
from pathlib import Path

from ..checks import at_least, between
from ..errors import ConfigError
from ..plugins.stylizers.config import RegionToneConfig, StylizerConfig
from .wishes import parse_strength, parse_wish

__all__ = ["NO_MASK", "StyleConfig"]

NO_MASK = Path("none")
"""Stands for the whole photograph among the masks."""


@dataclass(frozen=True, kw_only=True)
class StyleConfig:
    """How photographs become the style of a scene. REGION and REFERENCE are explained in `style.wishes`."""

    references: tuple[Path, ...] = ()
    """Photographs whose style the scene takes, or folders of them."""
    weights: tuple[float, ...] = ()
    """How much each reference counts, in their order, above 0; none = all alike."""
    masks: tuple[Path, ...] = ()
    """A picture for each reference, in their order: only what is white there makes style codes; `none` = all of it."""
    stylizer: StylizerConfig = RegionToneConfig()
    """What moves the scene's features."""
    clusters: int = 20
    """Local styles (codes) per reference, at least 1."""
    blend: float = 0.1
    """Share of the overall style in each local one, in [0, 1], on both sides: 0 = local, 1 = global."""
    strength: float = 1.0
    """0 leaves the scene bit for bit as it is, 1 is the full style."""
    luminance: float = 0.0
    """How much of the scene's own luminance is kept, in [0, 1]; at 1 the references give their tints alone."""
    pin: tuple[str, ...] = ()
    """REGION=REFERENCE: the region takes its style from this reference (from any of them, if pinned to several)."""
    forbid: tuple[str, ...] = ()
    """REGION=REFERENCE: the region takes nothing from this reference."""
    keep: tuple[str, ...] = ()
    """REGION: the region stays as it is."""
    region_strength: tuple[str, ...] = ()
    """REGION=STRENGTH in [0, 1]: how strongly the region is restyled, times the overall strength."""
    keep_below: float | None = None
    """Regions whose best score is lower stay as they are, unless pinned; a score is a cosine, in [-1, 1]. none = no limit."""
    between: Path | None = None
    """Another style file: the result lies between this style and that one, feature by feature."""
    at: float = 0.5
    """Where between the two styles, in [0, 1]: 0 = this one, 1 = the other."""

    def __post_init__(self) -> None:
        for name in ("blend", "strength", "luminance", "at"):
            between(name, getattr(self, name), 0.0, 1.0)
        at_least("clusters", self.clusters, 1)
        for weight in self.weights:
            at_least("weights", weight, 1e-6)
        if self.keep_below is not None:
            between("keep_below", self.keep_below, -1.0, 1.0)
        for name in ("pin", "forbid"):
            for text in getattr(self, name):
                parse_wish(name, text)
        for text in self.region_strength:
            parse_strength("region_strength", text)
        for name in ("weights", "masks"):
            given = len(getattr(self, name))
            if given and self.references and given != len(self.references):
                raise ConfigError(f"{name}: {given} {name} for {len(self.references)} references; give one each, or none")
