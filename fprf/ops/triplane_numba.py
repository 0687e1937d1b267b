"""Fused tri-plane lookup on the CPU, compiled by numba on first use and cached.

Forward runs over points. Backward runs over (scale, group of channels): no two tasks write the same number, so no locks, and
the sum over points has one order: bitwise the same for any number of threads.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from .backend import compiled

__all__ = ["backward", "density", "forward", "layout", "point_slopes", "summed", "usable", "variation", "variation_gradient"]

_LANES = 8
_SLICES = 4
"""Parts of the points with gradients of their own."""
_SMALL = 2**19
"""Numbers of a table below which that is worth the memory: 2 MiB a part."""
_EMPTY = np.empty(0, np.float32)


def usable(points: Tensor, table: Tensor) -> bool:
    """Float32 on the CPU, whole vectors of channels, and numba installed."""
    on_cpu = points.device.type == "cpu" and table.device.type == "cpu"
    return compiled() and on_cpu and points.dtype == table.dtype == torch.float32 and table.shape[1] % _LANES == 0


def layout(resolutions: Sequence[int]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Nodes a side, and first row, of every scale."""
    sizes = np.asarray(resolutions, dtype=np.int64)
    return sizes, np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(3 * sizes * sizes)[:-1]])


def forward(points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Tensor:
    """[N scales*F] of contiguous points [N 3] in a table [rows F]."""
    from . import triplane_kernels as kernels

    sizes, starts = layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    out = torch.empty(len(points), len(sizes) * channels)
    kernels.forward(points.view(-1).numpy(), flat, channels, sizes, starts, out.view(-1).numpy())
    return out


def density(
    points: Tensor, table: Tensor, resolutions: Sequence[int], weight: Tensor, limit: float, *, keep: bool
) -> tuple[Tensor, Tensor]:
    """[N] exp(min(feature . weight - 1, limit)) of contiguous points; features [N scales*F], or [0] unless they are kept."""
    from . import triplane_kernels as kernels

    sizes, starts = layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    out = torch.empty(len(points))
    latent = torch.empty(len(points), len(sizes) * channels) if keep else torch.empty(0)
    given = weight.detach().contiguous().numpy()
    kernels.density(
        points.view(-1).numpy(),
        flat,
        channels,
        sizes,
        starts,
        given,
        np.float32(limit),
        latent.view(-1).numpy(),
        out.numpy(),
    )
    return out, latent


def backward(
    points: Tensor,
    table: Tensor,
    resolutions: Sequence[int],
    grad: Tensor | None,
    raw: Tensor | None = None,
    weight: Tensor | None = None,
) -> Tensor:
    """Gradient of the table [rows F] for a gradient [N scales*F] of the lookup, and raw [N] weight [scales*F] in addition."""
    from . import triplane_kernels as kernels

    # A table of few scales gives few tasks; a small one can be summed up in parts. By sizes alone: the order of sums is fixed.
    size = table.numel()
    slices = _SLICES if size <= _SMALL and len(points) * len(resolutions) * table.shape[1] > size else 1
    out = torch.zeros(slices, *table.shape)
    kernels.backward(*_given(points, table, resolutions, grad, raw, weight), slices, out.view(-1).numpy())
    return out.sum(0) if slices > 1 else out[0]


def point_slopes(
    points: Tensor,
    table: Tensor,
    resolutions: Sequence[int],
    grad: Tensor | None,
    raw: Tensor | None = None,
    weight: Tensor | None = None,
) -> Tensor:
    """Gradient of the points [N 3], for what `backward` is given."""
    from . import triplane_kernels as kernels

    out = torch.empty(len(points), 3)
    kernels.point_slopes(*_given(points, table, resolutions, grad, raw, weight), out.view(-1).numpy())
    return out


def _given(
    points: Tensor, table: Tensor, resolutions: Sequence[int], grad: Tensor | None, raw: Tensor | None, weight: Tensor | None
) -> tuple[Any, ...]:
    """What both kernels of gradients read, flat; what is absent is empty."""
    sizes, starts = layout(resolutions)
    given = (_EMPTY if x is None else x.detach().contiguous().view(-1).numpy() for x in (grad, raw, weight))
    flat = table.detach().contiguous().view(-1).numpy()
    return points.detach().view(-1).numpy(), flat, table.shape[1], sizes, starts, *given


def summed(raw: Tensor, latent: Tensor) -> Tensor:
    """raw [N] @ latent [N C], bitwise the same for any number of threads, which a matrix product is not."""
    from . import triplane_kernels as kernels

    out = torch.zeros(kernels.PARTS, latent.shape[1])
    kernels.summed(raw.contiguous().numpy(), latent.view(-1).numpy(), latent.shape[1], out.view(-1).numpy())
    return out.sum(0)


def variation(table: Tensor, resolutions: Sequence[int]) -> Tensor:
    """Total variation, accumulated in float64."""
    from . import triplane_kernels as kernels

    sizes, starts = layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    return torch.tensor(kernels.variation(flat, channels, sizes, starts), dtype=table.dtype)


def variation_gradient(table: Tensor, resolutions: Sequence[int], scale: float) -> Tensor:
    """Gradient of `scale` times the total variation."""
    from . import triplane_kernels as kernels

    sizes, starts = layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    out = torch.empty_like(table, memory_format=torch.contiguous_format)
    kernels.variation_gradient(flat, channels, sizes, starts, scale, out.view(-1).numpy())
    return out
