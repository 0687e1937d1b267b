"""Bridge to the compiled forms of what happens along rays (`march_kernels`): CPU, float32. Rays and edges are constants.

`rendering.space` and `rendering.stepfun` hold the reference of each step. Distances in the contraction beyond which float32
cannot tell points apart, empty intervals and NaN are theirs, too: an index never leaves its array.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..types import Rays
from .backend import compiled

__all__ = [
    "Gathered",
    "Warp",
    "Weighed",
    "composite",
    "distances",
    "fit",
    "gather",
    "place",
    "propose",
    "still",
    "warp_of",
    "weigh",
]


Warp = Annotated[Tensor, "7"]
"""How a space maps to the unit cube, as the kernels take it."""


class Weighed(NamedTuple):
    """The samples of R rays by what is seen of them."""

    weights: Annotated[Tensor, "R S"]
    depth: Annotated[Tensor, "R"]
    opacity: Annotated[Tensor, "R"]
    through: Annotated[Tensor, "R"]
    keep: Annotated[Tensor, "R S"]
    start: Annotated[Tensor, "R+1"]
    """Where the kept samples of each ray begin, int64; at last where they end."""


class Gathered(NamedTuple):
    """The kept samples, ray after ray."""

    ray: Annotated[Tensor, "M"]
    weight: Annotated[Tensor, "M"]
    point: Annotated[Tensor, "M 3"]
    latent: Annotated[Tensor, "M L"]
    view: Annotated[Tensor, "M 3"]
    fair: Annotated[Tensor, "M"] | None


def fit(*tensors: Tensor) -> bool:
    """Float32 on the CPU, something to do, and numba is installed."""
    return compiled() and all(x.device.type == "cpu" and x.dtype == torch.float32 and x.numel() > 0 for x in tensors)


def still(*tensors: Tensor) -> bool:
    """Nobody wants gradients of these."""
    return not torch.is_grad_enabled() or not any(x.requires_grad for x in tensors)


def warp_of(kind: Literal["contraction", "box", "open"], low: tuple[float, ...], high: tuple[float, ...]) -> Warp:
    """The contraction, the box that becomes the unit cube, or distances of the one and points as they are."""
    corner = torch.tensor(low)
    number = float(("contraction", "box", "open").index(kind))
    return torch.cat([torch.tensor([number]), corner, 2 / (torch.tensor(high) - corner)])


def distances(s: Annotated[Tensor, "R E"], near: Annotated[Tensor, "R"], far: Annotated[Tensor, "R"], warp: Warp) -> Tensor:
    """Ray parameters [R E] of edges in [0, 1]."""
    from . import march_kernels as kernels

    t = torch.empty(s.shape)
    if t.numel() > 0:
        kernels.distances(_flat(s), _flat(near), _flat(far), _flat(warp), t.view(-1).numpy())
    return t


def propose(
    rays: Rays,
    s: Annotated[Tensor, "R E"],
    warp: Warp,
    table: Annotated[Tensor, "rows F"],
    resolution: int,
    weight: Annotated[Tensor, "F"],
    *,
    limit: float,
    padding: float,
    count: int,
    shift: Annotated[Tensor, "R 1"],
) -> Annotated[Tensor, "R count+1"]:
    """Where a plane field of one scale, of density exp(feature . weight - 1), wants the next level's edges.

    F is a multiple of 8. Behind an optical depth of 20 nothing is looked up.
    """
    from . import march_kernels as kernels

    out = torch.empty(len(s), count + 1)
    kernels.propose(
        _flat(rays.origin), _flat(rays.direction), _flat(rays.near), _flat(rays.far), _flat(s), _flat(warp), _flat(table),
        resolution, table.shape[1], _flat(weight), np.float32(limit), np.float32(padding), _flat(shift),
        out.view(-1).numpy(),
    )  # fmt: skip
    return out


def place(rays: Rays, t: Annotated[Tensor, "R E"], warp: Warp) -> Annotated[Tensor, "R S 3"]:
    """The middles of the steps between edges, in the unit cube."""
    from . import march_kernels as kernels

    point = torch.empty(len(t), t.shape[1] - 1, 3)
    if point.numel() > 0:
        kernels.place(_flat(rays.origin), _flat(rays.direction), _flat(t), _flat(warp), point.view(-1).numpy())
    return point


def weigh(
    density: Annotated[Tensor, "R S"],
    t: Annotated[Tensor, "R E"],
    budget: float,
    *,
    fair: Annotated[Tensor, "R S"] | None = None,
) -> Weighed:
    """Rendering weights, and the heaviest samples of each ray such that at most `budget` is left out.

    Weights and what passes through have a gradient in the densities, which `fair` multiplies.
    """
    if not still(density):
        return Weighed(*_Weigh.apply(density, t, budget, fair))  # type: ignore[no-untyped-call]
    return _weighed(density, t, budget)


def gather(
    weighed: Weighed,
    point: Annotated[Tensor, "R S 3"],
    latent: Annotated[Tensor, "R*S L"],
    view: Annotated[Tensor, "R 3"],
    fair: Annotated[Tensor, "R S"] | None = None,
) -> Gathered:
    """The kept ones of all samples; weights and latents have gradients."""
    given = (weighed.weights, latent, weighed.keep, weighed.start, point, view, fair)
    return _gathered(*given) if still(weighed.weights, latent) else Gathered(*_Gather.apply(*given))  # type: ignore[no-untyped-call]


def composite(
    weight: Annotated[Tensor, "M"], values: Annotated[Tensor, "M C"], start: Annotated[Tensor, "R+1"]
) -> Annotated[Tensor, "R C"]:
    """Weighted sums over the samples start[r] to start[r + 1] of each ray; both have gradients."""
    if not still(weight, values):
        found: Tensor = _Composite.apply(weight, values, start)  # type: ignore[no-untyped-call]
        return found
    return _composited(weight, values, start)


class _Weigh(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, density: Tensor, t: Tensor, budget: float, fair: Tensor | None) -> tuple[Tensor, ...]:
        found = _weighed(density, t, budget)
        ctx.save_for_backward(density, t, fair, found.weights, found.through)
        ctx.mark_non_differentiable(found.depth, found.opacity, found.keep, found.start)
        ctx.set_materialize_grads(False)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, None, None, None]:
        from . import march_gradient_kernels as kernels

        if grads[0] is None and grads[3] is None:
            return None, None, None, None
        density, t, fair, weights, through = ctx.saved_tensors
        out = torch.empty(density.shape)
        if out.numel() == 0:
            return out, None, None, None
        given = (_flat(x) for x in (density, t, fair, weights, through, grads[0], grads[3]))
        kernels.weigh_back(*given, out.view(-1).numpy())
        return out, None, None, None


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        weights: Tensor,
        latent: Tensor,
        keep: Tensor,
        start: Tensor,
        point: Tensor,
        view: Tensor,
        fair: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        found = _gathered(weights, latent, keep, start, point, view, fair)
        ctx.save_for_backward(keep, start)
        ctx.mark_non_differentiable(found.ray, found.point, found.view, *(() if found.fair is None else (found.fair,)))
        ctx.set_materialize_grads(False)
        return tuple(found)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        keep, start = ctx.saved_tensors
        return _spread(grads[1], keep, start), _spread(grads[3], keep, start), None, None, None, None, None


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weight: Tensor, values: Tensor, start: Tensor) -> Tensor:
        ctx.save_for_backward(weight, values, start)
        return _composited(weight, values, start)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        from . import march_gradient_kernels as kernels

        weight, values, start = ctx.saved_tensors
        g_weight = torch.empty(weight.shape) if ctx.needs_input_grad[0] else None
        g_values = torch.empty(values.shape) if ctx.needs_input_grad[1] else None
        kernels.composite_back(_flat(weight), _flat(values), start.numpy(), _flat(grads[0]), _flat(g_weight), _flat(g_values))
        return g_weight, g_values, None


def _weighed(density: Tensor, t: Tensor, budget: float) -> Weighed:
    from . import march_kernels as kernels

    rays = len(density)
    weights = torch.empty(density.shape)
    depth, opacity, through = torch.zeros(rays), torch.zeros(rays), torch.ones(rays)  # of no samples: nothing is seen
    keep, kept = torch.empty(density.shape, dtype=torch.bool), torch.zeros(rays + 1, dtype=torch.int64)
    if density.numel() > 0:
        kernels.weigh(
            _flat(density), _flat(t), np.float32(max(budget, 0.0)), weights.view(-1).numpy(), depth.numpy(),
            opacity.numpy(), through.numpy(), keep.view(-1).numpy(), kept[1:].numpy(),
        )  # fmt: skip
    return Weighed(weights, depth, opacity, through, keep, kept.cumsum(0))


def _gathered(
    weights: Tensor, latent: Tensor, keep: Tensor, start: Tensor, point: Tensor, view: Tensor, fair: Tensor | None
) -> Gathered:
    from . import march_kernels as kernels

    total = int(start[-1])
    out = Gathered(
        torch.empty(total, dtype=torch.int64),
        torch.empty(total),
        torch.empty(total, 3),
        torch.empty(total, latent.shape[-1]),
        torch.empty(total, 3),
        None if fair is None else torch.empty(total),
    )
    if total > 0:
        kernels.gather(
            keep.view(-1).numpy(), start[:-1].numpy(), _flat(weights), _flat(point), _flat(latent), _flat(view), _flat(fair),
            out.ray.numpy(), *(_flat(x) for x in out[1:]),
        )  # fmt: skip
    return out


def _spread(values: Tensor | None, keep: Tensor, start: Tensor) -> Tensor | None:
    from . import march_gradient_kernels as kernels

    if values is None:
        return None
    out = torch.empty(keep.shape) if values.dim() == 1 else torch.empty(keep.numel(), values.shape[1])
    if out.numel() > 0:
        kernels.spread(keep.view(-1).numpy(), start[:-1].numpy(), _flat(values), out.view(-1).numpy())
    return out


def _composited(weight: Tensor, values: Tensor, start: Tensor) -> Tensor:
    from . import march_gradient_kernels as kernels

    out = torch.empty(len(start) - 1, values.shape[1])
    if out.numel() > 0:
        kernels.composite(_flat(weight), _flat(values), start.numpy(), out.view(-1).numpy())
    return out


def _flat(x: Tensor | None) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    if x is None:
        return np.empty(0, np.float32)
    flat: np.ndarray[tuple[int], np.dtype[np.float32]] = x.detach().contiguous().view(-1).numpy()
    return flat
