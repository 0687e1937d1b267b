"""Config of guided upsampling (`ops.guided`). Imports no torch."""

from dataclasses import dataclass

from ..checks import at_least, between


@dataclass(frozen=True, kw_only=True)
class GuidedConfig:
    """Guided upsampling of feature maps: F(p) = A(p) I(p) + b(p), with A and b kept at a stride."""

    radius: float = 0.08
    """Window radius as a share of the image's shorter side (0.08 of 378 pixels is the paper's code's 30)."""
    eps: float = 1e-3
    """Regularisation in squared colour units, colours in [0, 1]; at least 1e-6."""
    stride: int = 8
    """Pixels between stored coefficients; at most a fifth of the window is used, so small images keep their
    accuracy.
    """

    def __post_init__(self) -> None:
        between("guided.radius", self.radius, 0.0, 1.0)
        at_least("guided.eps", self.eps, 1e-6)
        at_least("guided.stride", self.stride, 1)
