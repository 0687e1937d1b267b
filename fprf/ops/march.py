"""Bridge to the compiled forms of what happens along rays (`march_kernels`): CPU, float32, without gradients.

`rendering.space` and `rendering.stepfun` hold the reference of each step. Distances in the contraction beyond which float32
cannot tell points apart, empty intervals and NaN are theirs, too: an index never leaves its array.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..types import Rays
from .dense import array
from .dense import usable as usable

Warp = Annotated[Tensor, "7"]
"""Map of a space to the unit cube, as the kernels take it."""


class Weighed(NamedTuple):
    """The samples of R rays by what is seen of them."""

    weights: Annotated[Tensor, "R S"]
    depth: Annotated[Tensor, "R"]
    opacity: Annotated[Tensor, "R"]
    transmittance: Annotated[Tensor, "R"]
    """Of the whole ray."""
    keep: Annotated[Tensor, "R S"]
    start: Annotated[Tensor, "R+1"]
    """Offsets of the kept samples of each ray, int64; the last is their count."""


class Gathered(NamedTuple):
    """The kept samples, ray after ray."""

    ray: Annotated[Tensor, "M"]
    weight: Annotated[Tensor, "M"]
    point: Annotated[Tensor, "M 3"]
    latent: Annotated[Tensor, "M L"]
    view: Annotated[Tensor, "M 3"]


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
        kernels.distances(array(s), array(near), array(far), array(warp), t.view(-1).numpy())
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
    """Edges of the next level for a plane field of one scale, of density exp(feature . weight - 1).

    F is a multiple of 8. Behind an optical depth of 20 nothing is looked up.
    """
    from . import march_kernels as kernels

    out = torch.empty(len(s), count + 1)
    kernels.propose(
        array(rays.origin), array(rays.direction), array(rays.near), array(rays.far), array(s), array(warp), array(table),
        resolution, table.shape[1], array(weight), np.float32(limit), np.float32(padding), array(shift),
        out.view(-1).numpy(),
    )  # fmt: skip
    return out


def place(rays: Rays, t: Annotated[Tensor, "R E"], warp: Warp) -> Annotated[Tensor, "R S 3"]:
    """The middles of the steps between edges, in the unit cube."""
    from . import march_kernels as kernels

    point = torch.empty(len(t), t.shape[1] - 1, 3)
    if point.numel() > 0:
        kernels.place(array(rays.origin), array(rays.direction), array(t), array(warp), point.view(-1).numpy())
    return point


def weigh(density: Annotated[Tensor, "R S"], t: Annotated[Tensor, "R E"], budget: float) -> Weighed:
    """Rendering weights, and the heaviest samples of each ray such that at most `budget` is left out."""
    from . import march_kernels as kernels

    rays = len(density)
    weights = torch.empty(density.shape)
    depth, opacity, transmittance = torch.zeros(rays), torch.zeros(rays), torch.ones(rays)  # of no samples: nothing is seen
    keep, kept = torch.empty(density.shape, dtype=torch.bool), torch.zeros(rays + 1, dtype=torch.int64)
    if density.numel() > 0:
        kernels.weigh(
            array(density), array(t), np.float32(max(budget, 0.0)), weights.view(-1).numpy(), depth.numpy(),
            opacity.numpy(), transmittance.numpy(), keep.view(-1).numpy(), kept[1:].numpy(),
        )  # fmt: skip
    return Weighed(weights, depth, opacity, transmittance, keep, kept.cumsum(0))


def gather(
    weighed: Weighed, point: Annotated[Tensor, "R S 3"], latent: Annotated[Tensor, "R*S L"], view: Annotated[Tensor, "R 3"]
) -> Gathered:
    """The kept ones of all samples."""
    from . import march_kernels as kernels

    total = int(weighed.start[-1])
    out = Gathered(
        torch.empty(total, dtype=torch.int64),
        torch.empty(total),
        torch.empty(total, 3),
        torch.empty(total, latent.shape[-1]),
        torch.empty(total, 3),
    )
    if total > 0:
        kernels.gather(
            weighed.keep.view(-1).numpy(), weighed.start[:-1].numpy(), array(weighed.weights), array(point), array(latent),
            array(view), out.ray.numpy(), *(array(x) for x in out[1:]),
        )  # fmt: skip
    return out


def composite(
    weight: Annotated[Tensor, "M"], values: Annotated[Tensor, "M C"], start: Annotated[Tensor, "R+1"]
) -> Annotated[Tensor, "R C"]:
    """Weighted sums over the samples start[r] to start[r + 1] of each ray."""
    from . import march_kernels as kernels

    out = torch.empty(len(start) - 1, values.shape[1])
    if out.numel() > 0:
        kernels.composite(array(weight), array(values), start.numpy(), out.view(-1).numpy())
    return out
