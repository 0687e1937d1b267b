"""How a capture is looked at before it is restyled. Imports no torch."""

from dataclasses import dataclass

from ..checks import at_least


@dataclass(frozen=True, kw_only=True)
class LookConfig:
    """Views of a capture, from which its regions and statistics are found."""

    up: tuple[float, float, float] = (0.0, -1.0, 0.0)
    """Direction that points up in the capture's own axes; most captures have y down."""
    inside: bool | None = None
    """Look from within, as in rooms and streets, or around an object; none = found out."""
    views: int = 32
    """Views that are looked at."""
    size: tuple[int, int] = (320, 240)
    """Their width and height in pixels."""
    regions: int = 16
    """Semantic regions of the scene, at least 1."""

    def __post_init__(self) -> None:
        at_least("views", self.views, 1)
        at_least("regions", self.regions, 1)
        at_least("size", min(self.size), 32)
