"""The scene semantic field (paper): tri-planes and a network, no view direction, so that semantics agree across views."""

from collections.abc import Sequence
from typing import Annotated

import torch
from torch import Tensor, nn

from ..interfaces import SemanticField
from ..ops import dense
from .config import SemanticPlanesConfig
from .networks import mlp, weights
from .planes import Planes

__all__ = ["ProjectedPlanes", "SemanticPlanes"]


class SemanticPlanes(SemanticField):
    """K-Planes semantic field."""

    def __init__(self, config: SemanticPlanesConfig, *, channels: int, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.planes = Planes(config.resolutions, config.channels, generator=generator)
        self.network = mlp(self.planes.out, config.hidden, config.layers, channels, generator=generator)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Semantic features."""
        maps = weights(self.network)
        return dense.network(self.planes(points), maps, [None] * len(maps))

    def penalties(self) -> dict[str, Tensor]:
        """None: semantics need no smoothing beyond the planes' own resolution."""
        return {}

    @torch.no_grad()
    def projected(self, matrix: Annotated[Tensor, "D T"]) -> "ProjectedPlanes | None":
        """The last layer times the matrix, multiplied in float64; None where it would not be smaller."""
        *hidden, last = weights(self.network)
        if matrix.shape[1] >= len(last):
            return None
        return ProjectedPlanes(self.planes, [*hidden, (matrix.double().T @ last.double()).to(last)])


class ProjectedPlanes(SemanticField):
    """Linear functions of a field's features, by a network of which only the last layer differs from the field's own."""

    def __init__(self, planes: Planes, maps: Sequence[Tensor]) -> None:
        super().__init__()
        self.planes = planes
        self.maps = nn.ParameterList(nn.Parameter(weight.detach(), requires_grad=False) for weight in maps)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N T"]:
        """The functions' values."""
        maps = list(self.maps)
        return dense.network(self.planes(points), maps, [None] * len(maps))

    def penalties(self) -> dict[str, Tensor]:
        """None: it is not trained."""
        return {}
