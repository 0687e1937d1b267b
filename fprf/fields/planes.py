"""Learned tri-planes as a module: one table of parameters for all scales and planes (see `ops.triplane`)."""

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor, nn

from ..ops import triplane
from .density import density

__all__ = ["Planes"]


class Planes(nn.Module):
    """Points of the unit cube to `out` = scales x channels features."""

    def __init__(self, resolutions: Sequence[int], channels: int, *, generator: torch.Generator) -> None:
        super().__init__()
        self.resolutions = tuple(resolutions)
        self.out = len(self.resolutions) * channels
        # Positive start (K-Planes): a product of three zero-mean planes would start with no signal and no gradient.
        table = torch.empty(triplane.rows(self.resolutions), channels).uniform_(0.1, 0.5, generator=generator)
        self.table = nn.Parameter(table)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N out"]:
        """Features, coarse scales first."""
        return triplane.lookup(points, self.table, self.resolutions)

    def density(
        self, points: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "out"]
    ) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N out"]]:
        """`fields.density` of the features' product with the weight, and the features."""
        latent = self(points)
        return density(latent @ weight), latent

    def variation(self) -> Tensor:
        """Total variation: mean squared difference of neighbouring nodes, summed over scales."""
        return triplane.variation(self.table, self.resolutions)
