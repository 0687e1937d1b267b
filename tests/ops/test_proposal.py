"""Compiled proposals and middles against the plain forms in float64, in every kind of space."""

import pytest
import torch
from torch import Tensor

from fprf.fields.planes import MAX_LOG_DENSITY, ProposalField
from fprf.ops import backend, proposal
from fprf.plugins.samplers.config import ProposalConfig
from fprf.rendering.renderer import _located
from fprf.rendering.space import Kind, Space
from fprf.rendering.stepfun import midpoints, resample, transmittance_weights
from fprf.types import Rays

KINDS: tuple[Kind, ...] = ("box", "contraction", "ndc", "open")
UNITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def space_of(kind: Kind) -> Space:
    low = (-1.5, -1.0, -1.0)
    return Space(kind, (0.0, 0.0, 0.0), UNITY, 1.0, 0.1, 30.0, low=low, high=(1.0, 2.0, 1.0))


def rays_of(count: int, seed: int = 0) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    origin = torch.rand(count, 3, generator=generator) - 0.5
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    near = torch.full((count,), 0.1)
    return Rays(origin, direction, direction, near, near + 20 * torch.rand(count, generator=generator))


def wide(rays: Rays) -> Rays:
    return Rays(*(x.double() for x in rays))


def plainly(rays: Rays, s: Tensor, space: Space, field: ProposalField, count: int, shift: Tensor) -> Tensor:
    """The middle of each new edge's cell in the inverse distribution, from the plain forms."""
    t = space.distance(s, rays.near, rays.far)
    points = rays.origin[:, None] + rays.direction[:, None] * midpoints(t)[..., None]
    density = field(space.locate(points.view(-1, 3))).view(points.shape[:2])
    w = transmittance_weights(density, t) + 1e-2 / (s.shape[1] - 1)
    return w / w.sum(1, keepdim=True)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sharp", [1.0, 60.0])
def test_edges_lie_where_the_distribution_says(kind: Kind, sharp: float) -> None:
    rays = rays_of(50)
    space = space_of(kind)
    field = ProposalField(16, 8, seed=0)
    with torch.no_grad():
        field.to_density.weight.mul_(sharp)
        s = torch.linspace(0, 1, 49).expand(50, -1).contiguous()
        shift = torch.rand(50, 1, generator=torch.Generator().manual_seed(3))
        assert field.compiled(rays.origin, s)
        found = field.propose(rays, s, space, 14, padding=1e-2, shift=shift).double()
        field.double()
        share = plainly(wide(rays), s.double(), space, field, 14, shift.double())
    assert (found.diff(dim=1) >= 0).all() and (found >= 0).all() and (found <= 1).all()
    # The distribution up to each edge is what was asked for, within the error of weights (1e-6 of light a
    # step, over at least the padding's share of it).
    total = torch.cat([torch.zeros(50, 1, dtype=torch.float64), share.cumsum(1)], 1)
    at = found * 48
    low = at.floor().clamp(max=47).long()
    reached = total.gather(1, low) + (at - low) * share.gather(1, low)
    asked = (torch.arange(15) + shift.double()) / 15
    assert ((reached - asked).abs() < 5e-5).all()


def test_middles_are_those_of_the_plain_form() -> None:
    rays = rays_of(40)
    for kind in KINDS:
        space = space_of(kind)
        t = space.distance(torch.linspace(0, 1, 15).expand(40, -1), rays.near, rays.far)
        with torch.no_grad():
            found = _located(rays, t, midpoints(t), space)
            with backend.plain():
                plain = _located(rays, t, midpoints(t), space)
        assert torch.allclose(found, plain, rtol=4e-7, atol=4e-7), kind


def test_the_sampler_uses_it_and_agrees_with_the_plain_form() -> None:
    rays = rays_of(64)
    space = space_of("contraction")
    sampler = ProposalConfig(samples=(32, 24), resolutions=(16, 32), final=12).build(seed=0)
    with torch.no_grad():
        found = sampler(rays, space=space, step=None, generator=None)
        with backend.plain():
            plain = sampler(rays, space=space, step=None, generator=None)
    assert torch.allclose(found.s, plain.s, atol=2e-5)


def test_density_that_is_not_a_number_stays_to_be_seen() -> None:
    rays = rays_of(8)
    field = ProposalField(16, 8, seed=0)
    with torch.no_grad():
        field.to_density.weight[:] = float("nan")
        s = torch.linspace(0, 1, 9).expand(8, -1).contiguous()
        found = field.propose(rays, s, space_of("box"), 4, padding=1e-2, shift=torch.full((8, 1), 0.5))
    assert found.isnan().all()


def test_behind_what_is_opaque_there_is_only_padding() -> None:
    rays = rays_of(8)
    field = ProposalField(16, 8, seed=0)
    with torch.no_grad():
        field.planes.table.fill_(1.0)
        field.to_density.weight.fill_(MAX_LOG_DENSITY)
        s = torch.linspace(0, 1, 49).expand(8, -1).contiguous()
        found = field.propose(rays, s, space_of("box"), 10, padding=1e-2, shift=torch.full((8, 1), 0.5))
        plain = resample(
            s, torch.eye(48)[:1].expand(8, -1), 10, padding=1e-2, generator=None
        )  # all light in the first step
    assert torch.allclose(found, plain, atol=1e-5)


def test_learning_takes_the_plain_way() -> None:
    field = ProposalField(16, 8, seed=0)
    assert not proposal.usable(torch.zeros(1), learns=True)
    assert not ProposalField(16, 4, seed=0).compiled(torch.zeros(1, 3))
    assert not field.double().compiled(torch.zeros(1, 3))
