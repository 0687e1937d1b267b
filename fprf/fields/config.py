"""Field configs. `build` imports the implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from ..checks import at_least, between
from ..errors import ConfigError
from ..plugins.config import PluginConfig

if TYPE_CHECKING:
    from ..interfaces import ContentField, SemanticField


@dataclass(frozen=True, kw_only=True)
class ContentFieldConfig(PluginConfig):
    """Density and content features of a scene."""

    group: ClassVar[str] = "fprf.fields"

    def build(self, *, channels: int, seed: int) -> ContentField:
        """The field with so many content channels, its parameters drawn from the seed."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class SemanticFieldConfig(PluginConfig):
    """Semantic features of a scene, without direction."""

    group: ClassVar[str] = "fprf.fields"

    def build(self, *, channels: int, seed: int) -> SemanticField:
        """The field with so many semantic channels, its parameters drawn from the seed."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class PlanesConfig(ContentFieldConfig):
    """K-Planes: the product of three planes at several scales, then a small network (paper, content
    field).
    """

    resolutions: tuple[int, ...] = (64, 128, 256, 512)
    """Nodes along each side of the planes, coarse to fine."""
    channels: int = 32
    """Channels of each plane."""
    hidden: int = 256
    """Width of the content network."""
    layers: int = 2
    """Hidden layers of the content network."""
    degree: int = 4
    """Spherical-harmonics degree of the viewing direction (1 = none)."""

    def __post_init__(self) -> None:
        _check("content.field", self)
        between("content.field.degree", self.degree, 1, 4)

    def build(self, *, channels: int, seed: int) -> ContentField:
        from .planes import PlanesField

        return PlanesField(self, channels=channels, seed=seed)


@dataclass(frozen=True, kw_only=True)
class SemanticPlanesConfig(SemanticFieldConfig):
    """K-Planes for semantics: coarser, no direction (paper, semantic field)."""

    resolutions: tuple[int, ...] = (64, 128, 256, 512)
    """Nodes along each side of the planes, coarse to fine."""
    channels: int = 32
    """Channels of each plane."""
    hidden: int = 384
    """Width of the semantic network."""
    layers: int = 2
    """Hidden layers of the semantic network."""

    def __post_init__(self) -> None:
        _check("semantic.field", self)

    def build(self, *, channels: int, seed: int) -> SemanticField:
        from .planes import SemanticPlanes

        return SemanticPlanes(self, channels=channels, seed=seed)


def _check(name: str, config: PlanesConfig | SemanticPlanesConfig) -> None:
    if not config.resolutions:
        raise ConfigError(f"{name}.resolutions: none given; name at least one")
    # Bilinear samples need two nodes along each side.
    for r in config.resolutions:
        at_least(f"{name}.resolutions", r, 2)
    at_least(f"{name}.channels", config.channels, 1)
    at_least(f"{name}.hidden", config.hidden, 1)
    at_least(f"{name}.layers", config.layers, 0)
