"""The sampler of a scene of blocks: any sampler, whose own density fields are routed to blocks as the content field is."""

import torch
from torch import Tensor, nn

from ..interfaces import Sampler
from ..rendering.space import Space
from ..types import Rays, Sampled
from .members import Members
from .routing import Router

__all__ = ["BlockedSampler"]


class _Routed(nn.Module):
    """One density field of the sampler over all blocks."""

    def __init__(self, members: Members, router: Router, level: int) -> None:
        super().__init__()
        self.members, self.router, self.level = members, router, level

    def forward(self, points: Tensor) -> Tensor:
        groups = self.router(points)
        found = []
        for group in groups:
            here = points[group.at]
            values = [self.members.member(number).proposal(self.level, here) for number in group.members]
            found.append(values[0] if group.weight is None else (torch.stack(values, -1) * group.weight).sum(-1))
        if len(found) == 1:
            return found[0]
        index = torch.cat([group.at for group in groups])
        back = torch.empty_like(index)
        back[index] = torch.arange(len(index), device=index.device)
        return torch.cat(found).index_select(0, back)


class BlockedSampler(Sampler):
    """Samples as `inner` does, which the blocks' own fields tell where to look."""

    def __init__(self, inner: Sampler, members: Members, router: Router) -> None:
        super().__init__()
        self.members, self.router = members, router
        self.inner = inner
        for level in range(len(inner.fields)):
            inner.fields[level] = _Routed(members, router, level)

    def forward(
        self,
        rays: Rays,
        *,
        space: Space,
        step: int | None,
        generator: torch.Generator | None,
    ) -> Sampled:
        """The inner sampler's edges; an open space leaves points as they are."""
        found: Sampled = self.inner(rays, space=space, step=step, generator=generator)
        return found

    def penalties(self) -> dict[str, Tensor]:
        """Those of the samplers of the members that are held, added up."""
        terms = [member.sampler.penalties() for member in self.members.held]
        names = {name for each in terms for name in each}
        return {name: torch.stack([each[name] for each in terms if name in each]).sum() for name in sorted(names)}
