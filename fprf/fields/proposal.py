"""A proposal field: the least that can say where density is."""

from typing import Annotated

import torch
from torch import Tensor, nn

from ..ops import march, triplane_numba
from .networks import linear
from .planes import Planes

__all__ = ["ProposalField"]


class ProposalField(nn.Module):
    """One scale of small planes and a linear map to density."""

    def __init__(self, resolution: int, channels: int, *, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.planes = Planes((resolution,), channels, generator=generator)
        self.to_density = linear(self.planes.out, 1, generator=generator)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N"]:
        """Density per space unit at points of the unit cube."""
        return self.planes.density(points, self.to_density.weight[0])[0]

    def kernels_apply(self, *tensors: Tensor) -> bool:
        """Return whether `ops.march.propose` may read the planes: without gradients, on the CPU, channels in whole vectors."""
        return march.usable(*tensors) and triplane_numba.usable(tensors[0], self.planes.table)
