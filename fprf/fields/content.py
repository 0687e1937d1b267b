"""The scene content field (paper): tri-planes, a linear map to density, a network with view direction to content."""

from typing import Annotated

import torch
from torch import Tensor, nn

from ..interfaces import ContentField
from ..types import FieldSample
from .config import PlanesConfig
from .density import density
from .harmonics import count, harmonics
from .networks import linear, mlp
from .planes import Planes

__all__ = ["PlanesField"]


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
        latent = self.planes(points)
        return FieldSample(density(self.to_density(latent)[:, 0]), latent)

    def content(self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "M C"]:
        """Content features seen from a direction."""
        result: Tensor = self.to_content(torch.cat([latent, harmonics(view, self.degree)], -1)) + self.offset
        return result

    def penalties(self) -> dict[str, Tensor]:
        """'variation' of the planes."""
        return {"variation": self.planes.variation()}
