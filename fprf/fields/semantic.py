"""The scene semantic field (paper): tri-planes and a network, no view direction, so that semantics agree across views."""

from typing import Annotated

import torch
from torch import Tensor

from ..interfaces import SemanticField
from ..ops import dense
from .config import SemanticPlanesConfig
from .networks import mlp, weights
from .planes import Planes

__all__ = ["SemanticPlanes"]


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
