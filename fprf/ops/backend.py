"""Choice of an operation's form: a compiled kernel where one applies, or the plain torch form, the reference, everywhere."""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

_AVAILABLE = importlib.util.find_spec("numba") is not None
_PLAIN: ContextVar[bool] = ContextVar("fprf.ops.plain", default=False)


def compiled() -> bool:
    """True where kernels for the CPU may run: numba is installed, and nobody asked for the plain forms."""
    return _AVAILABLE and not _PLAIN.get()


def compiled_for(*tensors: Tensor) -> bool:
    """True where kernels for the CPU may run and take these tensors: float32 in host memory."""
    return compiled() and all(x.device.type == "cpu" and x.dtype == torch.float32 for x in tensors)


@contextmanager
def plain() -> Iterator[None]:
    """The plain forms alone, in this thread and within this block: what kernels are measured and tested against."""
    before = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(before)
