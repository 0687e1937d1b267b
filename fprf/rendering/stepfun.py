"""Step functions on sorted edges along rays.

Conventions. `s` or `t` are edges [R E], E = S+1, not decreasing; `w` are the S weights between them, w >= 0,
sum <= 1. `tau` is optical depth (density times length). Everything is float32 or better and independent for
each ray.
"""

from typing import Annotated, Any

import torch
from torch import Tensor


class _Weights(torch.autograd.Function):
    """w_i = exp(-sum_{j<i} tau_j) (1 - exp(-tau_i)), with its gradient written out.

    expm1 keeps thin media exact (1 - exp loses all of it at 1e-9), and its own autograd is wrong where the
    medium is opaque. dL/dtau_i = T_{i+1} g_i - sum_{j>i} w_j g_j.
    """

    @staticmethod
    def forward(ctx: Any, tau: Tensor) -> Tensor:
        before = torch.exp(-_before(tau))
        w = before * -torch.expm1(-tau)
        ctx.save_for_backward(w, before * torch.exp(-tau))
        return w

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        w, after = ctx.saved_tensors
        gw = grads[0] * w
        # Suffix sums of what lies behind; total minus prefix would cancel.
        behind = _before(gw.flip(-1)).flip(-1)
        result: Tensor = after * grads[0] - behind
        return result


def _before(x: Tensor) -> Tensor:
    """Sum of all earlier entries. Taking an entry off the inclusive sum again would round by its own size:
    the fog in front of a wall of optical depth 1e8 would be lost, and inf - inf is NaN.
    """
    return torch.nn.functional.pad(x[..., :-1], (1, 0)).cumsum(-1)


def transmittance_weights(
    density: Annotated[Tensor, "R S"], t: Annotated[Tensor, "R E"]
) -> Annotated[Tensor, "R S"]:
    """Rendering weights (paper, Eq. 2) of densities >= 0 between edges t; relative error <= 4u (1 + tau)."""
    weights: Tensor = _Weights.apply(density * (t[:, 1:] - t[:, :-1]))  # type: ignore[no-untyped-call]
    return weights


class _Scaled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, scale: Tensor) -> Tensor:
        ctx.save_for_backward(scale)
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (scale,) = ctx.saved_tensors
        return grads[0] * scale, None


def scale_gradient(x: Annotated[Tensor, "..."], scale: Annotated[Tensor, "..."]) -> Annotated[Tensor, "..."]:
    """The value x, with its gradient multiplied by `scale` (broadcast)."""
    result: Tensor = _Scaled.apply(x, scale)  # type: ignore[no-untyped-call]
    return result


def midpoints(t: Annotated[Tensor, "R E"]) -> Annotated[Tensor, "R S"]:
    """Middle of each step."""
    return 0.5 * (t[:, 1:] + t[:, :-1])


def shifts(s: Annotated[Tensor, "R E"], generator: torch.Generator | None) -> Annotated[Tensor, "R 1"]:
    """Shift of new edges, as a share of a step: one draw a ray, one half without a generator."""
    if generator is None:
        return torch.full((len(s), 1), 0.5, dtype=s.dtype, device=s.device)
    return torch.rand((len(s), 1), generator=generator, dtype=s.dtype, device=s.device)


def resample(
    s: Annotated[Tensor, "R E"],
    w: Annotated[Tensor, "R S"],
    count: int,
    *,
    padding: float,
    generator: torch.Generator | None,
) -> Annotated[Tensor, "R count+1"]:
    """Edges at even steps of the distribution w over s, shifted by one draw a ray (none: centred).

    `padding` is the total probability spread evenly, so that rays of weight 0 stay defined and every place
    can be found.
    """
    w = w + padding / w.shape[1]
    cdf = w.cumsum(-1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf / cdf[:, -1:]], -1)
    step = 1 / (count + 1)
    # Stratified: one even comb a ray through the inverse of the distribution, not independent draws.
    u = torch.linspace(0, 1 - step, count + 1, dtype=s.dtype, device=s.device) + shifts(s, generator) * step
    at = torch.searchsorted(cdf, u.contiguous(), right=True)
    low = (at - 1).clamp(0, s.shape[1] - 1)
    high = at.clamp(0, s.shape[1] - 1)
    c0 = cdf.gather(1, low)
    c1 = cdf.gather(1, high)
    s0 = s.gather(1, low)
    s1 = s.gather(1, high)
    # A step without probability has c1 == c0; any place inside it is right, 1e-12 only avoids 0/0.
    return s0 + ((u - c0) / (c1 - c0).clamp_min(1e-12)).clamp(0, 1) * (s1 - s0)


def interlevel(
    s: Annotated[Tensor, "R E"],
    w: Annotated[Tensor, "R S"],
    proposal_s: Annotated[Tensor, "R F"],
    proposal_w: Annotated[Tensor, "R Q"],
) -> Tensor:
    """Mean squared weight that the proposal fails to bound from above (mip-NeRF 360, Eq. 13), relative to w.

    Only the proposal learns from it.
    """
    w = w.detach()
    s = s.detach()
    total = torch.cat([torch.zeros_like(proposal_w[:, :1]), proposal_w.cumsum(-1)], -1)
    edges = proposal_s.contiguous()
    last = edges.shape[1] - 1
    # The proposal's weight over all its steps that touch a step of w bounds it from above.
    low = (torch.searchsorted(edges, s[:, :-1].contiguous(), right=True) - 1).clamp(0, last)
    high = torch.searchsorted(edges, s[:, 1:].contiguous()).clamp(0, last)
    bound = total.gather(1, high) - total.gather(1, low)
    # 1e-7 is float32's resolution of a weight: below it the ratio means nothing.
    return _mean((w - bound).clamp_min(0).square() / (w + 1e-7))


def distortion(s: Annotated[Tensor, "R E"], w: Annotated[Tensor, "R S"]) -> Tensor:
    """Mean over rays of sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 (s_i+1 - s_i) / 3 (mip-NeRF 360, Eq. 15), in
    O(S).
    """
    # Sorted middles: sums over pairs are prefix sums, since m_i >= m_j for all j < i.
    middle = midpoints(s)
    width = s[:, 1:] - s[:, :-1]
    before_w = w.cumsum(-1) - w
    before_m = (w * middle).cumsum(-1) - w * middle
    between = 2 * (w * (middle * before_w - before_m)).sum(-1)
    return _mean(between + (width * w.square()).sum(-1) / 3)


def _mean(x: Tensor) -> Tensor:
    """The mean; of nothing 0, so that a batch without rays has a loss and gradients of 0."""
    return x.sum() / max(1, x.numel())


def keep_heaviest(w: Annotated[Tensor, "R S"], budget: float) -> Annotated[Tensor, "R S"]:
    """Mask of the fewest samples of each ray such that the weight left out is at most `budget`.

    Colours lie in [0, 1], so leaving these out changes a pixel by at most the budget. Budget 0 drops exact
    zeros only.
    """
    if budget <= 0:
        return w > 0
    ordered, index = w.sort(-1)
    dropped = ordered.cumsum(-1) <= budget
    return torch.empty_like(dropped).scatter_(1, index, ~dropped)
