"""Proposals, compiled, against the plain form."""

from dataclasses import replace

import numba
import pytest
import torch
from torch import Tensor

from fprf.fields.planes import ProposalField
from fprf.ops import march
from fprf.rendering.space import Kind, Space
from fprf.rendering.stepfun import midpoints, resample, shifts, transmittance_weights
from fprf.types import Rays

EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
KINDS: tuple[Kind, ...] = ("contraction", "box", "ndc")


def space_of(kind: Kind) -> Space:
    space = Space(kind, (0.0, 0.0, 0.0), EYE, 1.0, 0.05, 1e3, focal=(1.5, 1.5))
    return replace(space, low=(-1.0, -2.0, -0.5), high=(1.5, 1.0, 2.0)) if kind == "box" else space


def rays_of(kind: Kind, count: int, seed: int = 0) -> Rays:
    draw = torch.Generator().manual_seed(seed)
    origin = torch.randn(count, 3, dtype=torch.float64, generator=draw) * 0.3
    direction = torch.randn(count, 3, dtype=torch.float64, generator=draw)
    if kind == "ndc":
        direction = direction * 0.2 - torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return space_of(kind).rays(origin, direction / direction.norm(dim=-1, keepdim=True))


def proposal(seed: int = 0, thickness: float = 4.0, resolution: int = 9, channels: int = 8) -> ProposalField:
    field = ProposalField(resolution, channels, seed=seed)
    with torch.no_grad():
        field.planes.table.mul_(thickness)
    return field.requires_grad_(False)


def proposed(field: ProposalField, rays: Rays, s: Tensor, space: Space, count: int, shift: Tensor) -> Tensor:
    return march.propose(
        rays,
        s,
        space.warp,
        field.planes.table,
        field.planes.resolutions[0],
        field.to_density.weight[0],
        limit=15.0,
        padding=1e-3,
        count=count,
        shift=shift,
    )


def plain_proposal(
    field: ProposalField, rays: Rays, s: Tensor, space: Space, count: int, generator: torch.Generator | None
) -> tuple[Tensor, Tensor]:
    """New edges of the plain form, and how much an edge moves per share of probability where it lies."""
    with torch.enable_grad():
        t = space.distance(s, rays.near, rays.far)
        points = rays.origin[:, None] + rays.direction[:, None] * midpoints(t)[..., None]
        w = transmittance_weights(field(space.locate(points.view(-1, 3))).view(points.shape[:2]), t)
        found = resample(s, w, count, padding=1e-3, generator=generator)
    p = (w + 1e-3 / w.shape[1]) / (w + 1e-3 / w.shape[1]).sum(-1, keepdim=True)
    slope = s.diff(dim=-1) / p
    at = (torch.searchsorted(s.contiguous(), found.contiguous(), right=True) - 1).clamp(0, w.shape[1] - 1)
    around = torch.stack([slope.gather(1, (at + k).clamp(0, w.shape[1] - 1)) for k in (-1, 0, 1)])
    return found, around.amax(0)


@torch.no_grad()
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("samples", "thickness"), [(5, 1.0), (16, 4.0), (50, 7.0)])
def test_proposals_are_those_of_the_plain_form(kind: Kind, samples: int, thickness: float) -> None:
    """A cumulative weight errs by some units of the densities' rounding, an edge by that times its step's slope."""
    space, rays, field = space_of(kind), rays_of(kind, 50), proposal(thickness=thickness)
    s = torch.linspace(0, 1, samples + 1).expand(50, -1)
    draws = [torch.Generator().manual_seed(3) for _ in range(2)]
    for one, other in ((None, None), draws):
        found = proposed(field, rays, s, space, 12, shifts(s, one))
        wanted, slope = plain_proposal(field, rays, s, space, 12, other)
        assert found.shape == wanted.shape == (50, 13) and (found.diff(dim=-1) >= 0).all()
        assert ((found - wanted).abs() <= 5e-5 * (1 + 0.1 * slope)).all()
        assert (found - wanted).abs().mean() <= 2e-5


@torch.no_grad()
def test_behind_a_wall_nothing_is_looked_up() -> None:
    """Planes that are NaN behind x = 0 (in the unit cube) and a wall before it: a ray along x never meets the NaN."""
    field, space = proposal(resolution=33), space_of("box")
    space = replace(space, low=(-1.0, -1.0, -1.0), high=(1.0, 1.0, 1.0))
    grid = field.planes.table.view(3, 33, 33, -1)
    grid.fill_(1.0)
    field.to_density.weight.fill_(1.0)
    grid[:2, :, 20:] = float("nan")
    rays = Rays(*(torch.tensor(v) for v in ([[-1.0, 0, 0]], [[1.0, 0, 0]], [[1.0, 0, 0]], [0.0], [2.0])))
    s = torch.linspace(0, 1, 97)[None]
    found = proposed(field, rays, s, space, 8, torch.full((1, 1), 0.5))
    assert found.isfinite().all() and float(found[0, -2]) < 0.1


@torch.no_grad()
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only: nothing to compare")
def test_one_thread_and_two_give_the_same_bits() -> None:
    space, rays, field = space_of("contraction"), rays_of("contraction", 333), proposal()
    s, results = torch.linspace(0, 1, 49).expand(333, -1), []
    for count in (1, 2):
        numba.set_num_threads(count)
        results.append(proposed(field, rays, s, space, 12, shifts(s, None)))
    assert torch.equal(*results)
