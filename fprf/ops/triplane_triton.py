"""Tri-planes on a GPU: one launch over all planes and scales, forward and backward (device code: `triplane_triton_kernels`).

Triton comes with torch for CUDA. Where it is not installed, or cannot compile (it needs a C compiler and Python's headers),
nothing here is usable, and the reference runs. With TRITON_INTERPRET=1 the same code runs on the CPU, number by number: slow,
for tests.

Gradients are summed up by atomic additions, whose order differs from run to run: bits may differ, within rounding.
"""

import importlib.util
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache

import torch
from torch import Tensor

from .backend import asked_plain

_AVAILABLE = importlib.util.find_spec("triton") is not None
_TILE = 1024
"""Numbers of a program's tile: channels times points. Compiled for compute capability 9.0 this leaves 72 registers a thread
forward and 102 backward, nothing spilled and no barrier; twice as many cost barriers, four times as many spill."""


def interpreted() -> bool:
    """True where Triton interprets its code on the CPU."""
    if not _AVAILABLE:
        return False
    import triton

    return bool(triton.knobs.runtime.interpret)


def usable(points: Tensor, table: Tensor) -> bool:
    """Triton on one CUDA device (or interpreted), points in float32, the table in float32, or half where nobody learns."""
    if not _AVAILABLE or asked_plain() or points.device != table.device or points.dtype != torch.float32:
        return False
    fixed = not (torch.is_grad_enabled() and table.requires_grad)
    stored = table.dtype == torch.float32 or (table.dtype == torch.float16 and fixed)
    if not stored or points.device.type not in ("cuda", "cpu"):
        return False
    return interpreted() or (points.device.type == "cuda" and _launches(points.device))


@cache
def _launches(device: torch.device) -> bool:
    """True where a kernel can be compiled and launched: tried once, and told where it cannot."""
    try:
        forward(torch.zeros(1, 3, device=device), torch.zeros(12, 1, device=device), (2,))
    except torch.OutOfMemoryError:
        raise
    except Exception as error:  # whatever a compiler, a linker or a driver raises
        reason = (str(error).splitlines() or [""])[0]
        warnings.warn(
            f"Triton cannot compile for {device} ({type(error).__name__}: {reason}): tri-planes run in plain torch, slower; "
            "install a C compiler and Python's headers (apt install gcc python3-dev)",
            stacklevel=2,
        )
        return False
    return True


def forward(points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Tensor:
    """[N scales*F] of contiguous points [N 3] in a table [rows F]."""
    from . import triplane_triton_kernels as kernels

    table = table.detach().contiguous()
    out = torch.empty(len(points), len(resolutions) * table.shape[1], device=points.device)
    if len(points) > 0:
        with _on(points):
            kernels.forward[_grid(points, table)](
                points, table, out, len(points), *_constants(table, resolutions), enable_fp_fusion=True
            )
    return out


def backward(points: Tensor, table: Tensor, resolutions: Sequence[int], grad: Tensor) -> Tensor:
    """Gradient of the table [rows F] for a contiguous gradient [N scales*F] of the lookup."""
    from . import triplane_triton_kernels as kernels

    table = table.detach().contiguous()
    out = torch.zeros_like(table)
    if len(points) > 0:
        with _on(points):
            kernels.backward[_grid(points, table)](
                points, table, grad, out, len(points), *_constants(table, resolutions), enable_fp_fusion=True
            )
    return out


def _constants(table: Tensor, resolutions: Sequence[int]) -> tuple[tuple[int, ...], int, int, int]:
    """Nodes a side of each scale, channels, channels rounded up to a power of two, points of a program."""
    lanes = 1 << (table.shape[1] - 1).bit_length()
    return tuple(resolutions), table.shape[1], lanes, max(1, _TILE // lanes)


def _grid(points: Tensor, table: Tensor) -> tuple[int]:
    block = _constants(table, ())[-1]
    return (-(-len(points) // block),)


def _on(points: Tensor) -> AbstractContextManager[object]:
    """Launches go to the current device, which need not be that of the points."""
    return torch.cuda.device(points.device) if points.device.type == "cuda" else nullcontext()
