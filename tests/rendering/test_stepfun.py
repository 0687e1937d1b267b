"""Step functions: weights at their derived bound on zip-NeRF's grid, resampling and losses against loops in
fp64.
"""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fprf.rendering import stepfun
from fprf.rendering.stepfun import interlevel, keep_heaviest, midpoints, resample, transmittance_weights

U = 2.0**-24
"""Unit round-off of float32."""
GRID = (0.0, 1e-38, 1e-10, 1.0, 1e10, 1e30)
SMALLEST = 2.0**-126
"""Below it float32 is denormal: an absolute error of that size is no error."""


def weights_oracle(tau: list[float]) -> list[float]:
    """One ray, float64, a loop."""
    before = 0.0
    result = []
    for x in tau:
        result.append(math.exp(-before) * -math.expm1(-x))
        before += x
    return result


def gradient_oracle(tau: list[float], g: list[float]) -> list[float]:
    """dL/dtau_i = exp(-sum_{j<=i} tau_j) g_i - sum_{j>i} w_j g_j, summed exactly."""
    w = weights_oracle(tau)
    through = [math.exp(-math.fsum(tau[: i + 1])) for i in range(len(tau))]
    return [
        through[i] * g[i] - math.fsum(w[j] * g[j] for j in range(i + 1, len(tau))) for i in range(len(tau))
    ]


def edges_of(width: Tensor) -> Tensor:
    return torch.nn.functional.pad(width.cumsum(-1), (1, 0))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_weights_on_the_grid_of_extremes(count: int) -> None:
    """Every pair of density and length of zip-NeRF's test, in rays of several.

    Within 4u (1 + tau) of fp64 relative to itself, tau the optical depth so far; gradients near fp64's.
    """
    pairs = list(itertools.product(GRID, GRID))
    for shift in range(0, len(pairs), 7):
        rays = [[pairs[(i + shift * k) % len(pairs)] for k in range(count)] for i in range(len(pairs))]
        # Optical depths go in as densities of unit steps, since edges at 1e30 swallow steps of 1.
        depth = torch.tensor([[min(d * x, 3e38) for d, x in ray] for ray in rays], requires_grad=True)
        w = transmittance_weights(depth, torch.arange(count + 1.0).repeat(len(pairs), 1))
        assert w.isfinite().all() and (w >= 0).all()
        for ray, weights in zip(depth.double().tolist(), w.double().tolist(), strict=True):
            tau = 0.0
            for x, a, b in zip(ray, weights, weights_oracle(ray), strict=True):
                assert abs(a - b) <= 4 * U * (1 + tau) * b + SMALLEST
                tau = min(tau + x, 1e3)
        g = torch.randn(w.shape, generator=torch.Generator().manual_seed(shift))
        (found,) = torch.autograd.grad((w * g).sum(), depth)
        assert found.isfinite().all()
        exact = torch.tensor(
            [gradient_oracle(t, x) for t, x in zip(depth.double().tolist(), g.double().tolist(), strict=True)]
        )
        assert ((found - exact).abs() <= 1e-5 * g.abs().amax(-1, keepdim=True)).all()


@pytest.mark.parametrize("wall", [1e6, 1e8, 1e20, float("inf")])
def test_fog_before_a_wall_is_not_lost(wall: float) -> None:
    """The wall's own depth must not round away what is in front of it, or weights sum to more than 1."""
    tau = torch.tensor([[0.3, 0.7, wall, 1.0]])
    w = transmittance_weights(tau, torch.arange(5.0)[None])[0]
    exact = torch.tensor([-math.expm1(-0.3), math.exp(-0.3) * -math.expm1(-0.7), math.exp(-1.0), 0.0])
    assert ((w - exact).abs() <= 4 * U * 2 * exact).all()
    assert abs(float(w.sum()) - 1) <= 8 * U


def inverse_cdf(s: list[float], w: list[float], padding: float, u: float) -> float:
    """Where a share u of the padded distribution lies before, float64."""
    w = [x + padding / len(w) for x in w]
    total = math.fsum(w)
    before = 0.0
    for i, x in enumerate(w):
        if u * total < before + x or i == len(w) - 1:
            return s[i] + (s[i + 1] - s[i]) * min((u * total - before) / x, 1.0) if x > 0 else s[i]
        before += x
    raise AssertionError


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 999), st.sampled_from([1e-3, 0.1]))
def test_resampling_inverts_the_distribution(bins: int, count: int, seed: int, padding: float) -> None:
    """Condition-limited: an error of 8u in the CDF moves a place by that over the density."""
    draw = torch.Generator().manual_seed(seed)
    width = torch.rand(2, bins, generator=draw) + 0.01
    s = edges_of(width) / width.sum(-1, keepdim=True)
    w = torch.rand(2, bins, generator=draw) ** 4
    w = w / w.sum(-1, keepdim=True)
    found = resample(s, w, count, padding=padding, generator=None)
    assert found.shape == (2, count + 1)
    density = (w + padding / bins) / (1 + padding) / s.diff(dim=-1)
    slack = 16 * U * (1 + 1 / float(density.min()))
    for ray in range(2):
        for k, place in enumerate(found[ray].tolist()):
            exact = inverse_cdf(s[ray].tolist(), w[ray].tolist(), padding, (k + 0.5) / (count + 1))
            assert abs(place - exact) <= slack


@given(st.integers(1, 60), st.integers(1, 80), st.integers(0, 9999), st.booleans())
def test_resampled_edges_are_sorted_and_inside(bins: int, count: int, seed: int, drawn: bool) -> None:
    """For spikes, zeros, denormals, repeated edges and whole rays of nothing: not one bit out of order."""
    draw = torch.Generator().manual_seed(seed)
    w = torch.rand(6, bins, generator=draw)
    w[0] = 0
    w[1] = torch.nn.functional.one_hot(torch.tensor(seed % bins), bins)
    w[2] = w[2] * (torch.rand(bins, generator=draw) > 0.5)
    w[3] = w[3] * 1e-38
    w[4] = w[4] ** 40
    s = torch.rand(6, bins + 1, generator=draw).sort(-1).values
    s[5] = s[5].round(decimals=1)
    generator = torch.Generator().manual_seed(seed) if drawn else None
    found = resample(s, w, count, padding=1e-3, generator=generator)
    assert found.isfinite().all()
    assert (found.diff(dim=-1) >= 0).all()
    assert (found >= s[:, :1]).all() and (found <= s[:, -1:]).all()


def test_draws_move_all_edges_of_a_ray_together_and_follow_the_distribution() -> None:
    s = torch.linspace(0, 1, 5).repeat(20_000, 1)
    w = torch.tensor([0.1, 0.0, 0.6, 0.3]).repeat(20_000, 1)
    drawn = resample(s, w, 3, padding=1e-6, generator=torch.Generator().manual_seed(0))
    share = torch.histc(drawn, 4, 0, 1) / drawn.numel()
    # Binomial deviation of 80 000 draws is at most 0.0018.
    assert (share - w[0]).abs().max() < 0.007
    again = resample(s, w, 3, padding=1e-6, generator=torch.Generator().manual_seed(0))
    assert torch.equal(drawn, again)


def interlevel_oracle(s: list[float], w: list[float], ps: list[float], pw: list[float]) -> float:
    """Bound of a step: all proposal weight whose bin touches it."""
    total = 0.0
    for i, x in enumerate(w):
        bound = math.fsum(p for j, p in enumerate(pw) if ps[j] < s[i + 1] and ps[j + 1] > s[i])
        total += max(0.0, x - bound) ** 2 / (x + 1e-7)
    return total / len(w)


@given(
    st.integers(1, 12),
    st.integers(1, 12),
    st.integers(0, 999),
    st.booleans(),
    st.sampled_from([1.0, 1e-3, 1e-7]),
)
def test_interlevel_is_the_weight_that_is_not_bounded(
    samples: int, proposed: int, seed: int, same: bool, size: float
) -> None:
    """Also for a proposal on the same edges, which bounds each step alone, and for faint weights, which cost
    a finite share.
    """
    draw = torch.Generator().manual_seed(seed)
    s = torch.rand(1, samples + 1, generator=draw).sort(-1).values
    ps = torch.cat([torch.zeros(1, 1), torch.rand(1, proposed, generator=draw).sort(-1).values], -1)
    ps[0, -1] = 1
    s = ps if same else s
    w = size * torch.rand(1, s.shape[1] - 1, generator=draw)
    pw = size * torch.rand(1, proposed, generator=draw)
    wanted = interlevel_oracle(s[0].tolist(), w[0].tolist(), ps[0].tolist(), pw[0].tolist())
    # Differences of prefix sums: a few u of their total, through a slope of at most 2.
    assert abs(float(interlevel(s, w, ps, pw)) - wanted) <= 20 * U * (size + float(pw.sum()))


def test_interlevel_teaches_the_proposal_alone() -> None:
    s = torch.linspace(0, 1, 9)[None].requires_grad_(True)
    w = torch.rand(1, 8, requires_grad=True)
    ps = torch.linspace(0, 1, 5)[None]
    low = torch.full((1, 4), 0.01, requires_grad=True)
    interlevel(s, w, ps, low).backward()
    assert w.grad is None and s.grad is None
    assert low.grad is not None and (low.grad < 0).all()
    whole = w.detach().view(1, 4, 2).sum(-1)
    assert float(interlevel(s, w, ps, whole)) <= (8 * U) ** 2 / 1e-7
    assert float(interlevel(s, w, ps, whole + 0.1)) == 0.0
    assert float(interlevel(s, w * 0, ps, whole * 0)) == 0.0


@given(st.integers(1, 40), st.integers(0, 999))
def test_distortion_is_the_double_sum(samples: int, seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    s = torch.rand(5, samples + 1, generator=draw).sort(-1).values
    w = torch.rand(5, samples, generator=draw)
    w = (w / w.sum(-1, keepdim=True)).requires_grad_(True)
    exact_w = w.detach().double().requires_grad_(True)
    exact_s = s.double()
    m = midpoints(exact_s)
    pairs = exact_w[:, :, None] * exact_w[:, None] * (m[:, :, None] - m[:, None]).abs()
    wanted = (pairs.sum((1, 2)) + (exact_w.square() * exact_s.diff(dim=-1)).sum(-1) / 3).mean()
    found = stepfun.distortion(s, w)
    # Weights sum to 1 and places lie in [0, 1]: prefix sums are off by a few u, whatever the result.
    assert abs(found.item() - wanted.item()) <= 16 * U
    (a,) = torch.autograd.grad(found, w)
    (b,) = torch.autograd.grad(wanted, exact_w)
    assert (a - b).abs().max() <= 1e-5 * max(1e-2, float(b.abs().max()))


@given(st.integers(1, 50), st.integers(0, 999), st.sampled_from([1e-6, 1 / 512, 0.1, 0.5, 1.0]))
def test_the_heaviest_are_kept_and_no_more_than_needed(samples: int, seed: int, budget: float) -> None:
    draw = torch.Generator().manual_seed(seed)
    w = torch.rand(6, samples, generator=draw) ** 8
    w = w / w.sum(-1, keepdim=True)
    w[0] = 0
    w[1, samples // 2 :] = 0
    kept = keep_heaviest(w, budget)
    exact = w.double()
    dropped = (exact * ~kept).sum(-1)
    slack = samples * U * budget + SMALLEST
    assert (dropped <= budget + slack).all()
    for ray in range(6):
        inside = w[ray][kept[ray]]
        outside = w[ray][~kept[ray]]
        if len(inside) and len(outside):
            assert outside.max() <= inside.min()
        if len(inside):  # dropping the lightest of the kept as well would exceed the budget
            assert float(dropped[ray]) + float(inside.min()) > budget - slack
    assert not kept[0].any()
