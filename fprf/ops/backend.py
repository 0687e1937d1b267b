"""Switches for a block of code: compiled kernels or plain torch, the reference everywhere; TF32. And float64
by device.
"""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

_AVAILABLE = importlib.util.find_spec("numba") is not None
_PLAIN: ContextVar[bool] = ContextVar("fprf.ops.plain", default=False)


def compiled() -> bool:
    """True where kernels may run: numba is installed, and nobody asked for the plain forms."""
    return _AVAILABLE and not _PLAIN.get()


def compiled_for(*tensors: Tensor) -> bool:
    """True where kernels for the CPU may run and take these tensors: float32 in host memory."""
    return compiled() and all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)


@contextmanager
def plain() -> Iterator[None]:
    """The plain forms alone, in this thread and within this block: what kernels are measured and tested
    against.
    """
    before = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(before)


@contextmanager
def tf32(enabled: bool) -> Iterator[None]:
    """Matrix products of float32 numbers on CUDA in TF32; a setting of the whole process, put back after the
    block.
    """
    if not enabled:
        yield
        return
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@contextmanager
def float32_convolutions(device: torch.device) -> Iterator[None]:
    """Convolutions on CUDA in float32, not in TF32, torch's own choice; a setting of the process, put back
    after the block.

    TF32 shifts features by 6e-4 to 1e-3 of their spread, after which k-means may end elsewhere: a style moved
    by 0.17 of a colour in [0, 1]. Under noise of 3e-4, 55 of 252 clusterings of references moved; under that
    of float32 (1e-6) none did.
    """
    if device.type != "cuda":
        yield
        return
    convolutions = torch.backends.cudnn.conv  # type: ignore[attr-defined]
    before = convolutions.fp32_precision
    convolutions.fp32_precision = "ieee"
    try:
        yield
    finally:
        convolutions.fp32_precision = before


def double(x: Tensor) -> Tensor:
    """The tensor in float64; on a device that has none (MPS), on the CPU."""
    return x.to(device=float64_device(x.device), dtype=torch.float64)


def float64_device(device: torch.device) -> torch.device:
    """The device, or the CPU where that one has no float64."""
    return torch.device("cpu") if device.type == "mps" else device
