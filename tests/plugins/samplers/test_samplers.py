"""Samplers: spacing, annealing, when proposals learn, and what they find."""

import itertools

import pytest
import torch
from torch import Tensor, nn

from fprf.interfaces import Sampler
from fprf.plugins.samplers.config import ProposalConfig, SamplerConfig, UniformConfig
from fprf.plugins.samplers.samplers import ProposalSampler
from fprf.rendering.space import Space
from fprf.rendering.stepfun import interlevel
from fprf.types import Rays, Sampled

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
SPACE = Space("contraction", (0.0, 0.0, 0.0), EYE, 1.0, 0.05, 1e3)
SMALL = ProposalConfig(samples=(16, 12), final=9, resolutions=(6, 8))


def rays_of(count: int, seed: int = 0) -> Rays:
    draw = torch.Generator().manual_seed(seed)
    origin, direction = (torch.randn(count, 3, dtype=torch.float64, generator=draw) for _ in range(2))
    return SPACE.rays(origin * 0.2, torch.nn.functional.normalize(direction, dim=-1))


def sample(sampler: Sampler, rays: Rays, step: int | None = None, seed: int | None = None) -> Sampled:
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    sampled: Sampled = sampler(rays, space=SPACE, step=step, generator=generator)
    return sampled


@pytest.mark.parametrize("config", [UniformConfig(samples=8), SMALL])
def test_edges_are_spaced_by_the_space(config: SamplerConfig) -> None:
    rays = rays_of(5)
    found = sample(config.build(seed=0), rays)
    assert torch.equal(found.t, SPACE.distance(found.s, rays.near, rays.far))
    assert (found.t >= 0.05 * (1 - 1e-6)).all() and (found.t <= 1e3 * (1 + 1e-6)).all()
    assert found.levels == ()


class Wall(nn.Module):
    """Dense where the first coordinate is beyond a place, thin before; stands in for a proposal, as blocks'
    fields do.
    """

    def __init__(self, at: float) -> None:
        super().__init__()
        self.at = at

    def forward(self, points: Tensor) -> Tensor:
        return torch.where(points[:, 0] > self.at, 200.0, 1e-4)


def wall(sampler: Sampler, at: float) -> None:
    assert isinstance(sampler, ProposalSampler)
    for k in range(len(sampler.levels)):
        sampler.levels[k] = Wall(at)


def test_samples_go_where_the_density_is() -> None:
    """A wall at x = 1 seen from the origin: all but the padding's share of the samples land about its
    surface.
    """
    sampler = ProposalConfig(samples=(128, 64), final=32, resolutions=(4, 4)).build(seed=0)
    rays = SPACE.rays(
        torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    )
    wall(sampler, 0.5)
    found = sample(sampler, rays)
    near = (found.t > 0.9) & (found.t < 1.15)
    assert int(near.sum()) >= 32
    untrusting = sample(sampler, rays, step=0)
    assert int(((untrusting.t > 0.9) & (untrusting.t < 1.15)).sum()) < 20


def test_annealing_rises_from_even_to_trusted() -> None:
    sampler = ProposalConfig(anneal_steps=100, anneal_slope=10.0).build(seed=0)
    assert isinstance(sampler, ProposalSampler)
    sharp = [sampler.sharpness(step) for step in range(120)]
    assert all(0 < a <= b <= 1 for a, b in itertools.pairwise(sharp))
    assert sharp[0] == pytest.approx(10 * 0.01 / (9 * 0.01 + 1)) and sharp[99] == sharp[119] == 1.0
    # mip-NeRF 360's bias curve: b x / ((b - 1) x + 1).
    assert sharp[9] == pytest.approx(1.0 / 1.9)
    at_once = ProposalConfig(anneal_steps=0).build(seed=0)
    assert isinstance(at_once, ProposalSampler) and at_once.sharpness(0) == 1.0


def test_proposals_learn_at_every_step_then_ever_more_rarely() -> None:
    sampler = ProposalConfig(update_every=5, warm_up=100).build(seed=0)
    assert isinstance(sampler, ProposalSampler)
    learns = [sampler.learns(step) for step in range(400)]
    assert all(learns[:10])
    shares = [sum(learns[a : a + 50]) / 50 for a in range(0, 400, 50)]
    assert all(a >= b for a, b in itertools.pairwise(shares))
    assert learns[100:] == [step % 5 == 0 for step in range(100, 400)]
    always = ProposalConfig(update_every=1, warm_up=0).build(seed=0)
    assert isinstance(always, ProposalSampler) and all(always.learns(step) for step in range(20))


def test_the_interlevel_loss_reaches_every_level() -> None:
    sampler = SMALL.build(seed=0)
    rays = rays_of(64)
    found = sample(sampler, rays, step=0)
    points = SPACE.locate((rays.origin[:, None] + rays.direction[:, None] * found.t[:, 1:, None]).view(-1, 3))
    weights = (points[:, 0].view(64, -1).abs() > 0.5).float() / 9
    loss = torch.stack([interlevel(found.s, weights, level.s, level.weights) for level in found.levels]).sum()
    reached = torch.autograd.grad(loss, list(sampler.parameters()))
    assert all(g.isfinite().all() and g.any() for g in reached)
