"""Proposal sampling (mip-NeRF 360): each level's density says where the next level looks."""

import torch
from torch import Tensor, nn

from ...fields.planes import ProposalField
from ...interfaces import Sampler
from ...rendering.space import Space
from ...rendering.stepfun import midpoints, resample, shifts, transmittance_weights
from ...types import Level, Rays, Sampled
from .config import ProposalConfig


class ProposalSampler(Sampler):
    """Coarse to fine. Proposals learn from the interlevel loss alone, ever more rarely after the warm-up.

    Without any level samples lie at even steps.
    """

    def __init__(self, config: ProposalConfig, *, seed: int) -> None:
        super().__init__()
        self.config = config
        self.levels = nn.ModuleList()
        for level, resolution in enumerate(config.resolutions):
            self.levels.append(ProposalField(resolution, config.channels, seed=seed + level))

    @property
    def fields(self) -> nn.ModuleList:
        return self.levels

    def forward(
        self,
        rays: Rays,
        *,
        space: Space,
        step: int | None,
        generator: torch.Generator | None,
    ) -> Sampled:
        """Edges for the content field, and the levels that proposed them where they learn in this step."""
        # Even steps at first; with a generator the edges within move together by up to half a step a ray.
        first, *counts = *self.config.samples, self.config.final
        s = torch.linspace(0, 1, first + 1, dtype=rays.near.dtype, device=rays.near.device).expand(
            len(rays.near), -1
        )
        if generator is not None:
            shift = torch.rand((len(s), 1), generator=generator, dtype=s.dtype, device=s.device) - 0.5
            s = torch.cat([s[:, :1], s[:, 1:-1] + shift / first, s[:, -1:]], 1)
        # Then each level's weights say where the next one looks (mip-NeRF 360, section 3).
        learns = step is not None and self.learns(step)
        sharpness = 1.0 if step is None else self.sharpness(step)
        levels = []
        for field, count in zip(self.levels, counts, strict=True):
            # A scene of blocks has fields of its own in the place of these.
            own = field if isinstance(field, ProposalField) else None
            if own is not None and not learns and sharpness == 1 and own.compiled(rays.origin, s):
                s = own.propose(
                    rays, s, space, count, padding=self.config.padding, shift=shifts(s, generator)
                )
                continue
            with torch.set_grad_enabled(learns):
                t = space.distance(s, rays.near, rays.far)
                points = rays.origin[:, None] + rays.direction[:, None] * midpoints(t)[..., None]
                # Density of the proposal at the middles, as weights (Eq. 2).
                density = field(space.locate(points.view(-1, 3))).view(points.shape[:2])
                w = transmittance_weights(density, t)
            if learns:
                levels.append(Level(s, w))
            # Early proposals are trusted less: weights to a power that rises to 1.
            if sharpness == 1:
                trusted = w.detach()
            else:
                trusted = w.detach().clamp_min(1e-7) ** sharpness
            s = resample(s, trusted, count, padding=self.config.padding, generator=generator)
        return Sampled(s, space.distance(s, rays.near, rays.far), tuple(levels))

    def penalties(self) -> dict[str, Tensor]:
        """'proposal_variation' of all levels' planes; none without levels."""
        parts = []
        for field in self.levels:
            assert isinstance(field, ProposalField)
            parts.append(field.planes.variation())
        if parts:
            return {"proposal_variation": torch.stack(parts).sum()}
        return {}

    def learns(self, step: int) -> bool:
        """Every step at first, every `update_every` steps after the warm-up, evenly rarer between."""
        every = 1 + (self.config.update_every - 1) * min(1.0, step / max(1, self.config.warm_up))
        return step % round(every) == 0

    def sharpness(self, step: int) -> float:
        """Exponent of the weights: rises from 0 to 1 over the annealing, so that no early error is locked
        in.
        """
        x = min(1.0, (step + 1) / max(1, self.config.anneal_steps))
        slope = self.config.anneal_slope
        return slope * x / ((slope - 1) * x + 1)
