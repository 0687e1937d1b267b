"""Even spacing in the space's own measure."""

import torch
from torch import Tensor

from ...interfaces import Sampler
from ...rendering.space import Space
from ...types import Rays, Sampled
from .config import UniformConfig

__all__ = ["UniformSampler", "even_edges"]


def even_edges(rays: Rays, samples: int, generator: torch.Generator | None) -> Tensor:
    """Edges s [R samples+1] at even steps; with a generator the inner ones move together by up to half a step a ray."""
    s = torch.linspace(0, 1, samples + 1, dtype=rays.origin.dtype, device=rays.origin.device).expand(len(rays.near), -1)
    if generator is None:
        return s
    shift = torch.rand((len(s), 1), generator=generator, dtype=s.dtype, device=s.device) - 0.5
    return torch.cat([s[:, :1], s[:, 1:-1] + shift / samples, s[:, -1:]], 1)


class UniformSampler(Sampler):
    """No proposal, no parameters."""

    def __init__(self, config: UniformConfig) -> None:
        super().__init__()
        self.samples = config.samples

    def forward(
        self,
        rays: Rays,
        *,
        space: Space,
        step: int | None,
        generator: torch.Generator | None,
    ) -> Sampled:
        """Even edges."""
        s = even_edges(rays, self.samples, generator)
        return Sampled(s, space.distance(s, rays.near, rays.far))

    def penalties(self) -> dict[str, Tensor]:
        """None."""
        return {}
