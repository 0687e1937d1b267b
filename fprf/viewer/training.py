"""How far a training run has come, as the page shows it. Imports nothing, so that who only waits stays small."""

from dataclasses import dataclass

__all__ = ["Training"]


@dataclass(frozen=True)
class Training:
    """Of one run, at one moment."""

    step: int = 0
    share: float = 0.0
    """Of the way, in [0, 1]; 1 = it is over."""
    psnr: float | None = None
    """Of the training rays; None = not known yet."""
    seconds_left: float | None = None
    what: str = ""
    """Which part of a scene in blocks."""
