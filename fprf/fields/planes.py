"""Learned tri-planes as a module: one table of parameters for all scales and planes (see `ops.triplane`)."""

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor, nn

from ..ops import dense, triplane
from .density import LIMIT, density

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

    def fused(self, points: Tensor) -> bool:
        """Whether kernels may read the table where these points lie, and nobody wants gradients."""
        return len(points) > 0 and not torch.is_grad_enabled() and triplane.fused(points, self.table)

    def density(
        self, points: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "out"]
    ) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N out"]]:
        """`fields.density` of the features' product with the weight, and the features."""
        if triplane.fused(points, self.table):
            return triplane.density(points, self.table, self.resolutions, weight, LIMIT)
        latent = self(points)
        return density(latent @ weight), latent

    def density_alone(self, points: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "out"]) -> Annotated[Tensor, "N"]:
        """The density where `fused`, without gradients."""
        return triplane.density_alone(points, self.table, self.resolutions, weight, LIMIT)

    def network(
        self,
        points: Annotated[Tensor, "N 3"],
        weights: Sequence[Tensor],
        biases: Sequence[Tensor | None],
        *,
        shared: Annotated[Tensor, "P J"] | None = None,
        row: Annotated[Tensor, "N"] | None = None,
    ) -> Annotated[Tensor, "N O"]:
        """`dense.network` of the features, which are never written where nobody learns."""
        if self.fused(points):
            return dense.plane_network(points, self.table, self.resolutions, weights, biases, shared=shared, row=row)
        return dense.network(self(points), weights, biases, shared=shared, row=row)

    def variation(self) -> Tensor:
        """Total variation: mean squared difference of neighbouring nodes, summed over scales."""
        return triplane.variation(self.table, self.resolutions)
