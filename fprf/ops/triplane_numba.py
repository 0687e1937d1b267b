"""Fused tri-plane lookup on the CPU, compiled by numba on first use and cached.

Forward runs over points. Backward runs over (scale, group of channels): no two tasks write the same number, so no locks, and
the sum over points has one order: bitwise the same for any number of threads.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .backend import compiled
from .dense import array

_LANES = 8
_SLICES = 4
"""Parts of the points with gradients of their own."""
_SMALL = 2**19
"""Numbers of a table below which that is worth the memory: 2 MiB a part."""


def usable(points: Tensor, table: Tensor) -> bool:
    """Float32 on the CPU, whole vectors of channels, and numba installed."""
    on_cpu = points.device.type == "cpu" and table.device.type == "cpu"
    return compiled() and on_cpu and points.dtype == table.dtype == torch.float32 and table.shape[1] % _LANES == 0


def forward(points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Tensor:
    """[N scales*F] of contiguous points [N 3] in a table [rows F]."""
    from . import triplane_kernels as kernels

    out = torch.empty(len(points), len(resolutions) * table.shape[1])
    kernels.forward(*_flat(points, table, resolutions), out.view(-1).numpy())
    return out


def backward(points: Tensor, table: Tensor, resolutions: Sequence[int], grad: Tensor) -> Tensor:
    """Gradient of the table [rows F] for a gradient [N scales*F] of the lookup."""
    from . import triplane_kernels as kernels

    # A table of few scales gives few tasks; a small one can be summed up in parts. By sizes alone: the order of sums is fixed.
    size = table.numel()
    slices = _SLICES if size <= _SMALL and len(points) * len(resolutions) * table.shape[1] > size else 1
    out = torch.zeros(slices, *table.shape)
    kernels.backward(*_flat(points, table, resolutions, grad), slices, out.view(-1).numpy())
    return out.sum(0) if slices > 1 else out[0]


def point_slopes(points: Tensor, table: Tensor, resolutions: Sequence[int], grad: Tensor) -> Tensor:
    """Gradient of the points [N 3] for a gradient [N scales*F] of the lookup."""
    from . import triplane_kernels as kernels

    out = torch.empty(len(points), 3)
    kernels.point_slopes(*_flat(points, table, resolutions, grad), out.view(-1).numpy())
    return out


def variation(table: Tensor, resolutions: Sequence[int]) -> Tensor:
    """Total variation, accumulated in float64."""
    from . import triplane_kernels as kernels

    return torch.tensor(kernels.variation(*_flat(table, table, resolutions)[1:]), dtype=table.dtype)


def variation_gradient(table: Tensor, resolutions: Sequence[int], scale: float) -> Tensor:
    """Gradient of `scale` times the total variation."""
    from . import triplane_kernels as kernels

    out = torch.empty_like(table, memory_format=torch.contiguous_format)
    kernels.variation_gradient(*_flat(table, table, resolutions)[1:], scale, out.view(-1).numpy())
    return out


def _flat(points: Tensor, table: Tensor, resolutions: Sequence[int], *more: Tensor) -> tuple[Any, ...]:
    """Points, table, its channels, nodes a side and first row of every scale, and further arrays, as kernels take them."""
    sizes = np.asarray(resolutions, dtype=np.int64)
    starts = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(3 * sizes * sizes)[:-1]])
    arrays = [array(x) for x in (points, table, *more)]
    return *arrays[:2], table.shape[1], sizes, starts, *arrays[2:]
