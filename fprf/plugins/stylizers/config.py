"""Stylizer configs. `build` imports the implementation.

Temperatures are relative unless said otherwise: 1 is the spread of the matching scores between this scene and
these references, so that one default serves every encoder. Small = each point takes one style code, large =
all codes mix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from ...checks import at_least, between, positive
from ..config import PluginConfig

if TYPE_CHECKING:
    from torch import Tensor

    from ...interfaces import Stylizer
    from ...style.dictionary import StyleDictionary
    from ...style.scene_style import SceneStyle


@dataclass(frozen=True, kw_only=True)
class StylizerConfig(PluginConfig):
    """Moves content features from the scene's style to the references'."""

    group: ClassVar[str] = "fprf.stylizers"

    handles_allowed_references: ClassVar[bool] = False
    """Its stylizers apply `StyleDictionary.allowed` themselves. For others every choice of references gets
    one of its own.
    """

    features: float = 1.0
    """Share of the change of features that counts, in [0, 1]."""
    colours: float = 0.0
    """Share by which the colours of each region are then carried to the colours of what it matches, in [0,
    1].
    """
    light: bool = False
    """What the references show nothing like keeps its material and takes their light; False = it is painted
    like the rest.
    """

    def __post_init__(self) -> None:
        between("stylizer.features", self.features, 0.0, 1.0)
        between("stylizer.colours", self.colours, 0.0, 1.0)

    def smoothing(
        self, scene: SceneStyle, allowed: Annotated[Tensor, "K references"] | None = None
    ) -> Annotated[Tensor, "K K"] | None:
        """Matrix that smooths the matches of regions (`style.scene_style.region_smoothing`); None = not
        smoothed.
        """
        return None

    def build(self, *, dictionary: StyleDictionary, scene: SceneStyle) -> Stylizer:
        """The stylizer of these references on this scene."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class AdainConfig(StylizerConfig):
    """Global AdaIN (paper, single reference): one mean and deviation of all references. Needs no
    semantics.
    """

    def build(self, *, dictionary: StyleDictionary, scene: SceneStyle) -> Stylizer:
        from .adain import AdainStylizer

        return AdainStylizer(dictionary, scene, None)


@dataclass(frozen=True, kw_only=True)
class LocalAdainConfig(StylizerConfig):
    """Local AdaIN (paper, Eq. 5 and 6): every point mixes the style codes that its semantics resemble."""

    temperature: float = 0.4
    """Softness of the match; above 0. The paper's is 1, its released code's 100, both with `relative`
    False.
    """
    relative: bool = True
    """Temperature is in units of the spread of the scores; False = in those of the scores themselves
    (paper).
    """
    similarity: Literal["cosine", "dot"] = "cosine"
    """Score of a match: cosine of the features, or their dot product (paper)."""
    centred: bool = True
    """Features are taken from the mean of the scene, keys from that of the references; False = as the encoder
    gives them (paper).
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("stylizer.temperature", self.temperature)

    def build(self, *, dictionary: StyleDictionary, scene: SceneStyle) -> Stylizer:
        from .adain import AdainStylizer

        return AdainStylizer(dictionary, scene, self)


@dataclass(frozen=True, kw_only=True)
class RegionConfig(StylizerConfig):
    """Common fields of two-sided stylizers: points belong to scene regions, regions match style codes."""

    handles_allowed_references: ClassVar[bool] = True
    transport: ClassVar[bool] = False
    """Map each region by the optimal transport of all channels; else AdaIN, channel by channel."""

    temperature: float = 0.4
    """Softness of the match between regions and style codes, relative to the spread of the scores; above
    0.
    """
    whitening: float = 0.5
    """Whitening of both sides' semantics before they are scored as cosines, in [0, 1]; 0 = none."""
    recentred: int = 1
    """Times that the references' centre is taken again from the codes that the scene takes; 0 = the mean of
    all codes.
    """
    centred: bool = True
    """Cosines are taken from the mean of each side; False = from the encoder's own origin, without whitening:
    for single objects, whose mean says nothing about that of a landscape.
    """
    smoothness: float = 0.0
    """Likeness of the styles of regions that meet without an edge of colour between them, at least 0; 0 =
    each by itself. It has no effect on runs of versions that did not measure which regions meet.
    """
    gain: float = 8.0
    """Largest amplification of any channel or direction, at least 1, so that the noise of flat regions stays
    small.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        positive("stylizer.temperature", self.temperature)
        between("stylizer.whitening", self.whitening, 0.0, 1.0)
        at_least("stylizer.recentred", self.recentred, 0)
        at_least("stylizer.smoothness", self.smoothness, 0.0)
        at_least("stylizer.gain", self.gain, 1.0)

    def smoothing(
        self, scene: SceneStyle, allowed: Annotated[Tensor, "K references"] | None = None
    ) -> Annotated[Tensor, "K K"] | None:
        """By `smoothness`."""
        from ...style.scene_style import region_smoothing

        return region_smoothing(scene, self.smoothness, allowed)

    def build(self, *, dictionary: StyleDictionary, scene: SceneStyle) -> Stylizer:
        from .region import TwoSidedStylizer

        return TwoSidedStylizer(dictionary, scene, self)


@dataclass(frozen=True, kw_only=True)
class RegionOtConfig(RegionConfig):
    """Two-sided optimal transport: regions match style codes, all channels move together."""

    transport: ClassVar[bool] = True


@dataclass(frozen=True, kw_only=True)
class RegionToneConfig(RegionConfig):
    """Two-sided (recommended): half of AdaIN's change, then each region's colours as a whole to those of its
    match.
    """

    features: float = 0.5
    """Share of the change of features (contrast, texture) that counts, in [0, 1]."""
    colours: float = 1.0
    """Share by which the colours of each region are then carried to the colours of what it matches, in [0,
    1].
    """
    light: bool = True
    """What the references show nothing like keeps its material and takes their light; False = it is painted
    like the rest.
    """
    temperature: float = 0.25
    """Softness of the match between regions and style codes, relative to the spread of the scores; above
    0.
    """
    smoothness: float = 16.0
    """Likeness of the styles of regions that meet without an edge of colour between them, at least 0; 0 =
    each by itself. It has no effect on runs of versions that did not measure which regions meet.
    """
