"""What happens along rays, compiled, against the plain form in fp64: distances, places, weights, proposals, what is kept."""

import math
from dataclasses import replace

import numba
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.fields.planes import ProposalField
from fprf.ops import march
from fprf.rendering.space import Kind, Space
from fprf.rendering.stepfun import keep_heaviest, midpoints, resample, shifts, transmittance_weights
from fprf.types import Rays

QUICK = settings(max_examples=25, deadline=None)
U = 2.0**-24
"""Unit round-off of float32."""
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


def double(rays: Rays) -> Rays:
    return Rays(*(x.double() for x in rays))


def edges(count: int, steps: int, seed: int = 0) -> Tensor:
    s = torch.rand(count, steps + 1, generator=torch.Generator().manual_seed(seed)).sort(-1).values
    s[:, 0], s[:, -1] = 0, 1
    return s


@torch.no_grad()
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 16, 37])
def test_distances_and_places_are_those_of_the_space(kind: Kind, count: int) -> None:
    space, rays, s = space_of(kind), rays_of(kind, count), edges(count, 21)
    exact, wide = space.distance(s.double(), rays.near.double(), rays.far.double()), double(rays)
    t = march.distances(s, rays.near, rays.far, space.warp)
    # s itself is given to u; in the far half t = 1 / (2c) carries c's error of a few u of 1/2 on to t^2.
    assert ((t - exact).abs() <= 8 * U * (exact + (exact.square() if kind == "contraction" else 1))).all()
    point = march.place(rays, t, space.warp)
    at = wide.origin[:, None] + wide.direction[:, None] * midpoints(t.double())[..., None]
    size = wide.origin.abs()[:, None] + wide.direction.abs()[:, None] * midpoints(t.double())[..., None]
    located = space.locate(at.view(-1, 3)).view(point.shape)
    # Contraction has slope 1/2 at most near the origin and 1 / |x| far out; a box one of 2 / (high - low).
    slope = size / at.abs().amax(-1, keepdim=True).clamp_min(1) if kind == "contraction" else 2 * size + 2
    assert ((point - located).abs() <= 8 * U * (1 + slope)).all()


def check_weights(density: Tensor, t: Tensor, found: march.Weighed) -> None:
    tau = density.double() * t.double().diff(dim=-1)
    before = torch.nn.functional.pad(tau[:, :-1], (1, 0)).cumsum(-1)
    exact = torch.exp(-before) * -torch.expm1(-tau)
    # As in `stepfun`, and 2u of each exponential; below exp(-87) weights are 0.
    assert ((found.weights - exact).abs() <= 4 * U * (2 + before.clamp(max=100)) * exact + 1e-37).all()
    total = tau.sum(-1)
    assert ((found.opacity + torch.expm1(-total)).abs() <= 8 * U * (1 + total) * -torch.expm1(-total) + 1e-37).all()
    assert ((found.transmittance - torch.exp(-total)).abs() <= 8 * U * (1 + total) * torch.exp(-total) + 1e-37).all()
    mass = exact.sum(-1)
    seen = mass > 1e-8
    depth = (exact * midpoints(t.double())).sum(-1) / mass
    assert torch.allclose(found.depth.double()[seen], depth[seen], rtol=1e-4 * 1e-1)


@torch.no_grad()
@pytest.mark.parametrize("samples", [1, 16, 100])
@pytest.mark.parametrize("thickness", [1e-9, 1.0, 1e8])
def test_weights_are_those_of_fp64(samples: int, thickness: float) -> None:
    draw = torch.Generator().manual_seed(samples)
    density = torch.rand(37, samples, generator=draw) * thickness
    t = torch.nn.functional.pad(torch.rand(37, samples, generator=draw).cumsum(-1), (1, 0))
    check_weights(density, t, march.weigh(density, t, 0.0))


@QUICK
@given(st.integers(1, 40), st.sampled_from([0.0, 1e-4, 1 / 512, 0.02, 0.3]), st.integers(0, 999))
def test_the_heaviest_are_kept(samples: int, budget: float, seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    density = torch.rand(20, samples, generator=draw).pow(4) * 30 / samples
    t = torch.arange(samples + 1.0).repeat(20, 1)
    with torch.no_grad():
        found = march.weigh(density, t, budget)
    left = found.weights.masked_fill(found.keep, 0.0)
    assert (left.double().sum(-1) <= budget * (1 + 1e-6)).all()
    assert found.start[0] == 0 and torch.equal(found.start.diff(), found.keep.sum(-1))
    # No fewer would do: the lightest that is kept does not fit any more, and none that is left out is heavier.
    lightest = found.weights.masked_fill(~found.keep, math.inf).amin(-1)
    assert (left.amax(-1) <= lightest).all()
    assert ((left.sum(-1) + lightest > budget * (1 - 1e-6)) | ~found.keep.any(-1)).all()
    plain = keep_heaviest(found.weights, budget)
    assert torch.equal(found.keep.sum(-1), plain.sum(-1))


@torch.no_grad()
@pytest.mark.parametrize("budget", [0.0, 0.1])
def test_kept_samples_and_their_sums_are_those_of_masks(budget: float) -> None:
    rays, steps, channels = 37, 11, 5
    draw = torch.Generator().manual_seed(3)
    density, t = 3 * torch.rand(rays, steps, generator=draw), torch.rand(rays, steps + 1, generator=draw).cumsum(1)
    density[:5] = 0  # of these nothing is kept
    point, latent = torch.rand(rays, steps, 3, generator=draw), torch.rand(rays * steps, channels, generator=draw)
    view = torch.rand(rays, 3, generator=draw)
    weighed = march.weigh(density, t, budget)
    kept = march.gather(weighed, point, latent, view)
    row, _ = weighed.keep.nonzero().unbind(1)
    assert len(row) > 0 and (budget == 0 or len(row) < rays * steps)
    assert torch.equal(kept.ray, row) and torch.equal(kept.weight, weighed.weights[weighed.keep])
    assert torch.equal(kept.point, point[weighed.keep]) and torch.equal(kept.view, view[row])
    assert torch.equal(kept.latent, latent.view(rays, steps, channels)[weighed.keep])
    wanted = torch.zeros(rays, channels, dtype=torch.float64)
    wanted.index_add_(0, row, kept.weight.double()[:, None] * kept.latent.double())
    found = march.composite(kept.weight, kept.latent, weighed.start)
    assert found.shape == wanted.shape and ((found - wanted).abs() <= (steps + 1) * U * wanted).all()


@torch.no_grad()
def test_a_nan_is_kept_to_be_seen() -> None:
    density = torch.full((2, 5), 0.1)
    density[0, 3] = float("nan")
    found = march.weigh(density, torch.arange(6.0).repeat(2, 1), 0.3)
    assert found.weights[0, 3:].isnan().all() and found.keep[0, 3:].all() and found.weights[1].isfinite().all()


@torch.no_grad()
def test_of_no_samples_nothing_is_seen() -> None:
    weighed = march.weigh(torch.zeros(3, 0), torch.ones(3, 1), 0.0)
    assert weighed.weights.shape == weighed.keep.shape == (3, 0)
    assert torch.equal(weighed.start, torch.zeros(4, dtype=torch.int64))
    assert torch.equal(weighed.opacity, torch.zeros(3)) and torch.equal(weighed.depth, torch.zeros(3))
    assert torch.equal(weighed.transmittance, torch.ones(3))


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
        new = proposed(field, rays, s, space, 12, shifts(s, None))
        t = march.distances(new, rays.near, rays.far, space.warp)
        weighed = march.weigh(torch.rand(333, 12, generator=torch.Generator().manual_seed(0)), t, 0.01)
        results.append((new, t, march.place(rays, t, space.warp), *weighed))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
