"""A parsed scene: where its images lie, how they were taken, what is for training. No image is decoded yet."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from torch import Tensor

from ..rendering.cameras import Cameras

__all__ = ["Scene"]


@dataclass(frozen=True, kw_only=True)
class Scene:
    """V views of one place. Cameras are at the size that images are used at (after `downscale`)."""

    name: str
    paths: tuple[Path, ...]
    """One image a view, as delivered; loading resizes it to the camera's size."""
    cameras: Cameras
    train: Annotated[Tensor, "T"]
    """int64 indices of the training views."""
    test: Annotated[Tensor, "U"]
    """int64 indices of the held-out views (every 8th by name, unless the capture says)."""
    points: Annotated[Tensor, "P 3"] | None = None
    """Sparse points of the reconstruction, float64 world, for bounds."""
    depths: Annotated[Tensor, "V 2"] | None = None
    """Nearest and farthest depth along each view's axis, where the capture says."""
    seen: Annotated[Tensor, "O 2"] | None = None
    """int64 pairs of a view and a point that the reconstruction found in it, where the capture says."""
    exposure: Annotated[Tensor, "V"] | None = None
    """Exposure of each view, where the capture says: light is in proportion to it. float64, above 0."""
    masks: tuple[Path | None, ...] = ()
    """A mask of each view, black where pixels are left out; None = all are used. Empty where the capture has none."""
    sky_masks: tuple[Path | None, ...] = ()
    """The same of sky, which is white."""
    alpha: bool = False
    """Images carry transparency."""
