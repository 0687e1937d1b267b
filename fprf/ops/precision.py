"""TF32 within a block or nowhere in it, and float64 where a device has it."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor


@contextmanager
def tf32(enabled: bool) -> Iterator[None]:
    """Matrix products of float32 numbers on CUDA in TF32; a setting of the whole process, put back after the block."""
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
def float32_convolutions() -> Iterator[None]:
    """No convolution on CUDA in TF32, torch's own choice there; a setting of the whole process, put back after the block.

    Features that are off by 1e-4 are clustered otherwise: a style then moved by up to 0.1 of a colour in [0, 1].
    """
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
