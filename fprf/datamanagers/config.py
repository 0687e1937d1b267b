"""Data manager configs. `build` imports the implementation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from ..checks import at_least, between
from ..ops.config import GuidedConfig
from ..plugins.config import PluginConfig
from .parsers.config import DataParserConfig

if TYPE_CHECKING:
    from torch import Tensor

    from ..interfaces import DataManager, Encoder
    from .basis import Basis
    from .scene import ParsedScene


@dataclass(frozen=True, kw_only=True)
class TrainingPixels:
    """Source of batches."""

    scene: ParsedScene
    seen: Callable[[int], Tensor] | None = None
    """Pixels [H W] of a view that batches are drawn from, for a block of a larger scene; None = all."""
    background: tuple[float, float, float] | None = None
    """Colour that transparent pixels show, RGB in [0, 1]; None = white."""


@dataclass(frozen=True, kw_only=True)
class FeatureTargets:
    """Maker of the features of a batch."""

    content: Encoder | None = None
    semantic: Encoder | None = None
    dim: int = 0
    """Principal semantic components that the field learns."""
    basis: Basis | None = None
    """Basis of a larger scene, for a block of it; None = of the training views."""


@dataclass(frozen=True, kw_only=True)
class DataManagerConfig(PluginConfig):
    """Feeds training with pixels and their feature targets."""

    group: ClassVar[str] = "fprf.datamanagers"

    parser: DataParserConfig | None = None
    """Format of the scene folder; none = recognised from what lies in it."""
    masks: bool = True
    """Leave out, in training and metrics, what the capture's masks name (`masks/` beside the images, or
    `mask_path`), and keep the sky empty where `sky_masks/` show it.
    """
    guided: GuidedConfig = GuidedConfig()
    """Edge-aware upsampling of the targets, and of references alike."""

    def build(
        self,
        pixels: TrainingPixels,
        targets: FeatureTargets,
        *,
        cache: Path,
        seed: int,
        progress: Callable[[int, int, str], None] | None = None,
    ) -> DataManager:
        """The data manager; features are computed into `cache` unless they lie there already.

        `progress(done, total, what)` is told of the features.
        """
        raise NotImplementedError

    def batch_rays(self) -> int:
        """Rays of a batch, for estimates."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class RayBatchesConfig(DataManagerConfig):
    """Random pixels of all training views."""

    rays: int = 4096
    """Rays per step."""
    semantic_share: float = 1.0
    """Share of the rays that also carry a semantic target."""
    depth_share: float = 0.25
    """Share of the rays that are drawn through sparse points of the reconstruction, where there are any, for
    `loss.depth`.
    """

    def __post_init__(self) -> None:
        between("datamanager.depth_share", self.depth_share, 0.0, 1.0)
        at_least("datamanager.rays", self.rays, 1)
        between("datamanager.semantic_share", self.semantic_share, 0.0, 1.0)

    def build(
        self,
        pixels: TrainingPixels,
        targets: FeatureTargets,
        *,
        cache: Path,
        seed: int,
        progress: Callable[[int, int, str], None] | None = None,
    ) -> DataManager:
        from .batches import RayBatches

        return RayBatches(self, pixels, targets, cache=cache, seed=seed, progress=progress)

    def batch_rays(self) -> int:
        """As many as `rays`."""
        return self.rays
