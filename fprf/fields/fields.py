"""The fields of a scene on tri-planes (paper): content and density, semantics, and the proposals of the sampler."""

from typing import Annotated

import torch
from torch import Tensor, nn

from ..interfaces import ContentField, SemanticField
from ..ops import dense, march, triplane_numba
from ..types import FieldSample
from .config import PlanesConfig, SemanticPlanesConfig
from .planes import Planes, count, harmonics, linear, mlp, weights

__all__ = ["PlanesField", "ProposalField", "SemanticPlanes"]


class PlanesField(ContentField):
    """K-Planes content field. Density bypasses the network, so that it is cheap where nothing is seen."""

    def __init__(self, config: PlanesConfig, *, channels: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.degree = config.degree
        self.planes = Planes(config.resolutions, config.channels, generator=generator)
        self.to_density = linear(self.planes.out, 1, generator=generator)
        inputs = self.planes.out + count(config.degree)
        self.to_content = mlp(inputs, config.hidden, config.layers, channels, generator=generator)
        # Decoders expect features of about their training scale; zero start would stall behind a frozen decoder.
        self.offset = nn.Parameter(torch.zeros(channels))

    def density(self, points: Annotated[Tensor, "N 3"]) -> FieldSample:
        """Density per space unit; the latent is the plane feature."""
        return FieldSample(*self.planes.density(points, self.to_density.weight[0]))

    def content(self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "M C"]:
        """Content features seen from a direction; what samples of one ray have in common is computed once."""
        first, run = dense.runs(view)
        maps, shared = weights(self.to_content), harmonics(view.index_select(0, first), self.degree)
        biases = [None] * (len(maps) - 1) + [self.offset]
        return dense.network(latent, maps, biases, shared=shared, row=run)

    def penalties(self) -> dict[str, Tensor]:
        """'variation' of the planes."""
        return {"variation": self.planes.variation()}


class SemanticPlanes(SemanticField):
    """K-Planes semantic field."""

    def __init__(self, config: SemanticPlanesConfig, *, channels: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.planes = Planes(config.resolutions, config.channels, generator=generator)
        self.network = mlp(self.planes.out, config.hidden, config.layers, channels, generator=generator)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        maps = weights(self.network)
        return dense.network(self.planes(points), maps, [None] * len(maps))

    def penalties(self) -> dict[str, Tensor]:
        """None: semantics need no smoothing beyond the planes' own resolution."""
        return {}


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
