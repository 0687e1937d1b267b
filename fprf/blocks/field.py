"""Fields of a scene of blocks: points go to the members that they belong to, density and features are blended, then decoded.

Densities blend by the weights of the router: sigma = sum_i w_i sigma_i. Features blend by what each member emits there,
f = sum_i w_i sigma_i f_i / sum_i w_i sigma_i: a block that finds a place empty has no say about its colour. Shares are formed
in log space, since densities span thirty orders of magnitude.
"""

from typing import Annotated

import torch
from torch import Tensor, nn

from ..interfaces import ContentField, SemanticField
from ..types import FieldSample
from .members import Members
from .routing import Group, Router

__all__ = ["BlockedField", "BlockedSemantic", "emission"]

_SHARED = -1.0
"""Instead of a member's number in the latent of a point that several members share."""


def emission(density: Annotated[Tensor, "n m"], weight: Annotated[Tensor, "n m"]) -> Annotated[Tensor, "n m"]:
    """Share of each member in what is emitted at a point; rows sum to 1, also where no member has any density."""
    tiny = torch.finfo(density.dtype).tiny
    return torch.softmax(density.clamp_min(tiny).log() + weight.log(), -1)


class BlockedField(ContentField):
    """Density and content. A latent is the member's number, the point, and the member's own latent.

    Points that several members share are looked up again for their content: only those that are kept, and few lie in margins.
    """

    def __init__(self, members: Members, router: Router) -> None:
        super().__init__()
        self.members, self.router = members, router
        self.held = nn.ModuleList(members.held)

    def density(self, points: Annotated[Tensor, "N 3"]) -> FieldSample:
        """Blended density; points are those of the scene's space."""
        groups = self.router(points)
        found = [self._group(points, group) for group in groups]
        index = torch.cat([group.at for group in groups])
        density, latent = (torch.cat(parts) for parts in zip(*found, strict=True))
        if len(groups) == 1:
            return FieldSample(density, latent)
        back = torch.empty_like(index)
        back[index] = torch.arange(len(index), device=index.device)
        return FieldSample(density.index_select(0, back), latent.index_select(0, back))

    def content(self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "M C"]:
        """Blended content features."""
        owner, points = latent[:, 0].detach(), latent[:, 1:4].detach()
        whole = self.router.whole(points)
        if whole is not None and whole.weight is None:
            return self.members.member(whole.members[0]).field.content(latent[:, 4:], view)
        if whole is not None:
            return self._shared(points, view, whole)
        found, places = [], []
        for number in torch.unique(owner).tolist():
            index = (owner == number).nonzero()[:, 0]
            if number != _SHARED:
                found.append(self.members.member(int(number)).field.content(latent[index, 4:], view[index]))
                places.append(index)
                continue
            for group in self.router(points[index]):
                place = index[group.at]
                found.append(self._shared(points[place], view[place], group))
                places.append(place)
        if len(found) == 1:
            return found[0]
        if not found:
            return self.members.held[0].field.content(latent[:, 4:], view)
        order = torch.cat(places)
        back = torch.empty_like(order)
        back[order] = torch.arange(len(order), device=order.device)
        return torch.cat(found).index_select(0, back)

    def penalties(self) -> dict[str, Tensor]:
        """Those of the members that are held, added up: each is regularised as if alone."""
        return _added([member.field.penalties() for member in self.members.held])

    def _group(self, points: Tensor, group: Group) -> tuple[Tensor, Tensor]:
        here = points[group.at]
        samples = [self.members.member(m).field.density(self.members.member(m).chart.locate(here)) for m in group.members]
        if group.weight is None:
            density, number = samples[0].density, here.new_full((len(here), 1), float(group.members[0]))
        else:
            density = (torch.stack([s.density for s in samples], -1) * group.weight).sum(-1)
            number = here.new_full((len(here), 1), _SHARED)
        return density, torch.cat([number, here, samples[0].latent], -1)

    def _shared(self, points: Tensor, view: Tensor, group: Group) -> Tensor:
        densities, contents = [], []
        for number in group.members:
            member = self.members.member(number)
            sample = member.field.density(member.chart.locate(points))
            densities.append(sample.density)
            contents.append(member.field.content(sample.latent, view))
        return _mixed(contents, densities, group)


class BlockedSemantic(SemanticField):
    """Semantics, blended as content is."""

    def __init__(self, members: Members, router: Router) -> None:
        super().__init__()
        self.members, self.router = members, router

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Blended features at points of the scene's space."""
        groups = self.router(points)
        found = []
        for group in groups:
            here = points[group.at]
            features, densities = [], []
            for number in group.members:
                member = self.members.member(number)
                assert member.semantic is not None
                at = member.chart.locate(here)
                features.append(member.semantic(at))
                if group.weight is not None:
                    densities.append(member.field.density(at).density)
            found.append(_mixed(features, densities, group))
        if len(found) == 1:
            return found[0]
        index = torch.cat([group.at for group in groups])
        back = torch.empty_like(index)
        back[index] = torch.arange(len(index), device=index.device)
        return torch.cat(found).index_select(0, back)

    def penalties(self) -> dict[str, Tensor]:
        """Those of the members that are held, added up."""
        return _added([member.semantic.penalties() for member in self.members.held if member.semantic is not None])


def _mixed(features: list[Tensor], densities: list[Tensor], group: Group) -> Tensor:
    if group.weight is None:
        return features[0]
    share = emission(torch.stack(densities, -1), group.weight)
    return (torch.stack(features, 1) * share[..., None]).sum(1)


def _added(terms: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    names = {name for each in terms for name in each}
    return {name: torch.stack([each[name] for each in terms if name in each]).sum() for name in sorted(names)}
