"""Fused tri-plane lookup on the CPU, compiled by numba on first use and cached.

Forward runs over points. Backward runs over (scale, group of channels): no two tasks write the same number, so no locks, and
the sum over points has one order: bitwise the same for any number of threads.
"""

import importlib.util
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

__all__ = ["backward", "forward", "usable", "variation", "variation_gradient"]

_AVAILABLE = importlib.util.find_spec("numba") is not None
_LANES = 8


def usable(points: Tensor, table: Tensor) -> bool:
    """Float32 on the CPU, whole vectors of channels, and numba installed."""
    on_cpu = points.device.type == "cpu" and table.device.type == "cpu"
    return _AVAILABLE and on_cpu and points.dtype == table.dtype == torch.float32 and table.shape[1] % _LANES == 0


def _layout(resolutions: Sequence[int]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Nodes a side, and first row, of every scale."""
    sizes = np.asarray(resolutions, dtype=np.int64)
    return sizes, np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(3 * sizes * sizes)[:-1]])


def forward(points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Tensor:
    """[N scales*F] of contiguous points [N 3] in a table [rows F]."""
    from . import triplane_kernels as kernels

    sizes, starts = _layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    out = torch.empty(len(points), len(sizes) * channels)
    kernels.forward(points.numpy(), flat, channels, sizes, starts, out.view(-1).numpy())
    return out


def backward(points: Tensor, table: Tensor, resolutions: Sequence[int], grad: Tensor) -> Tensor:
    """Gradient of the table [rows F] for a gradient [N scales*F] of the lookup."""
    from . import triplane_kernels as kernels

    sizes, starts = _layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    out = torch.zeros_like(table, memory_format=torch.contiguous_format)
    kernels.backward(points.numpy(), flat, channels, sizes, starts, grad.view(-1).numpy(), out.view(-1).numpy())
    return out


def variation(table: Tensor, resolutions: Sequence[int]) -> Tensor:
    """Total variation, accumulated in float64."""
    from . import triplane_kernels as kernels

    sizes, starts = _layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    return torch.tensor(kernels.variation(flat, channels, sizes, starts), dtype=table.dtype)


def variation_gradient(table: Tensor, resolutions: Sequence[int], scale: float) -> Tensor:
    """Gradient of `scale` times the total variation."""
    from . import triplane_kernels as kernels

    sizes, starts = _layout(resolutions)
    flat, channels = table.detach().contiguous().view(-1).numpy(), table.shape[1]
    out = torch.empty_like(table, memory_format=torch.contiguous_format)
    kernels.variation_gradient(flat, channels, sizes, starts, scale, out.view(-1).numpy())
    return out
