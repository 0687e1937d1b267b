"""Fields of a scene of blocks: points go to the members that they belong to, density and features are
blended, then decoded.

Densities blend by the weights of the router: sigma = sum_i w_i sigma_i. Features blend by what each member
emits there, f = sum_i w_i sigma_i f_i / sum_i w_i sigma_i: a block that finds a place empty has no say about
its colour. Shares are formed in log space, since densities span thirty orders of magnitude.

A block starts as the surroundings it is trained in: what they have learnt of its place is not learnt again.
Planes are laid anew over the block's chart, each node with the value that the old planes have there; networks
are copied. The finer nodes then hold the coarse scene, which training sharpens. Parts that consist of
anything else start from their seed.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Annotated

import torch
from torch import Tensor, nn

from ..fields.planes import Planes
from ..interfaces import ContentField, Sampler, SemanticField
from ..ops.triplane import AXES, split
from ..rendering.cameras import look_up
from ..rendering.space import Space
from ..types import FieldSample, Rays, Sampled
from .routing import Chart, Group, Router


class Member(nn.Module):
    """Fields and sampler of one block, and where they apply. Points are those of the scene's space."""

    def __init__(
        self, chart: Chart, sampler: Sampler, field: ContentField, semantic: SemanticField | None
    ) -> None:
        super().__init__()
        self.chart = chart
        self.sampler = sampler
        self.field = field
        self.semantic = semantic


class Members(ABC):
    """Members by number: in memory, or fetched when they are asked for."""

    held: Sequence[Member]
    """Members that live as long as the model, whose parameters are its own."""

    @abstractmethod
    def member(self, number: int) -> Member:
        """One of them."""


class ResidentMembers(Members):
    """Members that are all in memory."""

    def __init__(self, members: Sequence[Member]) -> None:
        self.held = members

    def member(self, number: int) -> Member:
        return self.held[number]


def emission(density: Annotated[Tensor, "n m"], weight: Annotated[Tensor, "n m"]) -> Annotated[Tensor, "n m"]:
    """Share of each member in what is emitted at a point; rows sum to 1, also where no member has any
    density.
    """
    tiny = torch.finfo(density.dtype).tiny
    return torch.softmax(density.clamp_min(tiny).log() + weight.log(), -1)


class BlockedField(ContentField):
    """Density and content. A latent is the point, then the latent of its member.

    Points that several members share are looked up again for their content: only those that are kept, and few
    lie in borders.
    """

    def __init__(self, members: Members, router: Router) -> None:
        super().__init__()
        self.members = members
        self.router = router
        self.held = nn.ModuleList(members.held)

    def density(self, points: Annotated[Tensor, "N 3"]) -> FieldSample:
        """Blended density; points are those of the scene's space."""
        groups = self.router(points)
        densities = []
        latents = []
        for group in groups:
            here = points[group.at]
            members = []
            for number in group.members:
                members.append(self.members.member(number))
            samples = []
            for member in members:
                samples.append(member.field.density(member.chart.locate(here)))
            densities.append(_blended([sample.density for sample in samples], group))
            latents.append(torch.cat([here, samples[0].latent], -1))
        density = _joined([group.at for group in groups], densities)
        latent = _joined([group.at for group in groups], latents)
        return FieldSample(density, latent)

    def content(
        self, latent: Annotated[Tensor, "M L"], view: Annotated[Tensor, "M 3"]
    ) -> Annotated[Tensor, "M C"]:
        points = latent[:, :3].detach()
        own = latent[:, 3:]
        groups = self.router(points)
        contents = []
        for group in groups:
            # One member alone decodes what its density was found with.
            if group.weight is None:
                at = slice(None) if len(groups) == 1 else group.at
                contents.append(self.members.member(group.members[0]).field.content(own[at], view[at]))
                continue
            # Several are looked up again: the latent holds one of them.
            samples = []
            features = []
            for number in group.members:
                member = self.members.member(number)
                sample = member.field.density(member.chart.locate(points[group.at]))
                samples.append(sample.density)
                features.append(member.field.content(sample.latent, view[group.at]))
            contents.append(_mixed(features, samples, group))
        if not groups:  # of no point
            return self.members.held[0].field.content(own, view)
        return _joined([group.at for group in groups], contents)

    def penalties(self) -> dict[str, Tensor]:
        """Penalties of the members in memory, added up: each is regularised as if alone."""
        return add_penalties(member.field.penalties() for member in self.members.held)


class BlockedSemantic(SemanticField):
    """Semantics, blended as content is."""

    def __init__(self, members: Members, router: Router) -> None:
        super().__init__()
        self.members = members
        self.router = router

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N D"]:
        """Blended features at points of the scene's space."""
        groups = self.router(points)
        outputs = []
        for group in groups:
            here = points[group.at]
            features = []
            densities = []
            for number in group.members:
                member = self.members.member(number)
                assert member.semantic is not None
                at = member.chart.locate(here)
                features.append(member.semantic(at))
                if group.weight is not None:
                    densities.append(member.field.density(at).density)
            outputs.append(_mixed(features, densities, group))
        return _joined([group.at for group in groups], outputs)

    def penalties(self) -> dict[str, Tensor]:
        """Penalties of the members in memory, added up."""
        parts = []
        for member in self.members.held:
            parts.append(member.semantic)
        return add_penalties(part.penalties() for part in parts if part is not None)


def _blended(densities: list[Tensor], group: Group) -> Annotated[Tensor, "n"]:
    """sum_i w_i sigma_i of a group's members."""
    if group.weight is None:
        return densities[0]
    return (torch.stack(densities, -1) * group.weight).sum(-1)


def _mixed(features: list[Tensor], densities: list[Tensor], group: Group) -> Annotated[Tensor, "n C"]:
    """sum_i e_i f_i of a group's members, e their `emission`."""
    if group.weight is None:
        return features[0]
    share = emission(torch.stack(densities, -1), group.weight)
    return (torch.stack(features, 1) * share[..., None]).sum(1)


def _joined(at: list[Tensor], parts: list[Tensor]) -> Tensor:
    """Values of groups in the order of the points; `at` are the points that each part belongs to."""
    if len(at) == 1:
        return parts[0]
    order = torch.cat(at)
    back = torch.empty_like(order)
    back[order] = torch.arange(len(order), device=order.device)
    return torch.cat(parts).index_select(0, back)


def add_penalties(terms: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Penalties of several parts by name; those of one name are added up."""
    added: dict[str, Tensor] = {}
    for each in terms:
        added |= {name: added[name] + value if name in added else value for name, value in each.items()}
    return added


class _Routed(nn.Module):
    """One density field of the sampler over all blocks."""

    def __init__(self, members: Members, router: Router, level: int) -> None:
        super().__init__()
        self.members = members
        self.router = router
        self.level = level

    def forward(self, points: Tensor) -> Tensor:
        groups = self.router(points)
        outputs = []
        for group in groups:
            members = []
            for number in group.members:
                members.append(self.members.member(number))
            densities = []
            for each in members:
                densities.append(each.sampler.fields[self.level](each.chart.locate(points[group.at])))
            outputs.append(_blended(densities, group))
        return _joined([group.at for group in groups], outputs)


class BlockedSampler(Sampler):
    """Samples as `inner` does, which the blocks' own fields tell where to look."""

    def __init__(self, inner: Sampler, members: Members, router: Router) -> None:
        super().__init__()
        self.members = members
        self.router = router
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
        outputs: Sampled = self.inner(rays, space=space, step=step, generator=generator)
        return outputs

    def penalties(self) -> dict[str, Tensor]:
        """Penalties of the samplers of the members in memory, added up."""
        return add_penalties(member.sampler.penalties() for member in self.members.held)


def inherit(member: Member, around: Member) -> None:
    """Let a member of the same config start as `around` is where it lies."""
    for name in ("sampler", "field", "semantic"):
        own = getattr(member, name)
        other = getattr(around, name)
        if own is None or other is None:
            continue
        # Only parts that consist of planes, linear maps and offsets: of others nobody knows what depends on
        # the chart.
        modules = []
        for module in own.modules():
            if isinstance(module, Planes | nn.Linear):
                modules.append(module)
        known = set()
        for module in modules:
            for parameter in module.parameters():
                known.add(id(parameter))
        planes = any(isinstance(module, Planes) for module in modules)
        others = []
        for parameter in own.parameters():
            if id(parameter) not in known:
                others.append(parameter)
        if not planes or any(parameter.ndim != 1 for parameter in others):
            continue
        # Networks are copied, planes are resampled where the block lies.
        own.load_state_dict(other.state_dict())
        for mine, theirs in zip(own.modules(), other.modules(), strict=True):
            if isinstance(mine, Planes) and isinstance(theirs, Planes):
                with torch.no_grad():
                    mine.table.copy_(resample_planes(theirs, member.chart, around.chart))


def resample_planes(planes: Planes, chart: Chart, old: Chart) -> Annotated[Tensor, "rows F"]:
    """The table of planes over `chart` that say what `planes` say over `old`, exact at the nodes."""
    middle = (chart.low + chart.high) / 2
    half = (chart.high - chart.low) / 2
    parts = []
    for grids in split(planes.table.detach(), planes.resolutions):
        nodes = torch.linspace(-1, 1, grids.shape[1], dtype=torch.float64)
        for grid, (a, b) in zip(grids, AXES, strict=True):
            # Nodes [R R 3] of the plane in the new cube, at 0 along the third axis, and where they lie in the
            # old one.
            cube = torch.zeros(len(nodes), len(nodes), 3, dtype=torch.float64)
            cube[..., a], cube[..., b] = nodes[None, :], nodes[:, None]
            at = old.locate((cube * half + middle).view(-1, 3)).view(cube.shape)
            # Nodes -1 to 1 are the centres of the first and the last pixel.
            pixel = 0.5 * (torch.stack([at[..., a], at[..., b]], -1) + 1) * (len(nodes) - 1) + 0.5
            parts.append(look_up(grid, pixel.view(-1, 2)).to(grid))
    return torch.cat(parts)
