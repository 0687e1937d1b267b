"""What was found out about a scene before it was trained: the part of scene.json that a model is rebuilt from."""

from dataclasses import dataclass

from ..checks import between
from ..rendering.space import Space
from ..types import Origin

_MAX_CHANNELS = 2**16
"""Channels that a file may ask for: a spoilt one must not take all memory."""
_MAX_SPACE_DISTANCE = 1e30
"""Distance that a file may ask for, space units: float32 ends at 3.4e38."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts of a trained scene: enough to rebuild its model without images or encoders."""

    space: Space
    channels: int = 0
    """Content channels; 0 = the scene is not of fields."""
    dim: int = 0
    """Semantic channels of the field; 0 = no semantics."""
    content_encoder: str = ""
    """Identity of the content encoder, to which the decoder belongs."""
    semantic_encoder: str = ""
    """Identity of the semantic encoder; empty without one."""
    content_scale: float = 1.0
    """RMS standard deviation of the content targets: the unit of the content loss."""
    semantic_scale: float = 1.0
    """RMS standard deviation of the semantic targets: the unit of the semantic loss."""
    background: tuple[float, float, float] | None = None
    """Colour behind everything, if anything can be seen through."""
    exposure: tuple[float, ...] = ()
    """Logarithm of each view's exposure over their mean (see `prepare.exposure_of`); empty where tones are
    not learnt.
    """
    held: tuple[int, ...] = ()
    """Views that neither tones nor poses are learnt from."""
    centres: tuple[tuple[float, float, float], ...] = ()
    """Centres of the cameras, in the world, as the capture says; empty where poses are not refined."""
    reach: float = 1.0
    """World distance that views commonly see: the unit in which cameras are shifted."""
    origin: Origin = (0.0, 0.0, 0.0)
    """Origin of the local frame that all of the run is in (see `rendering.local_frame`)."""

    def __post_init__(self) -> None:
        for name in ("channels", "dim"):
            between(name, getattr(self, name), 0, _MAX_CHANNELS)
        for name in ("near", "far"):
            between(f"space.{name}", getattr(self.space, name), 0, _MAX_SPACE_DISTANCE)
