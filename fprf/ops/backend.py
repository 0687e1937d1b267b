"""Choice of an operation's form: a compiled kernel where one applies, or the plain torch form, the reference, everywhere."""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_AVAILABLE = importlib.util.find_spec("numba") is not None
_PLAIN: ContextVar[bool] = ContextVar("fprf.ops.plain", default=False)


def compiled() -> bool:
    """True where kernels for the CPU may run: numba is installed, and nobody asked for the plain forms."""
    return _AVAILABLE and not _PLAIN.get()


@contextmanager
def plain() -> Iterator[None]:
    """The plain forms alone, in this thread and within this block: what kernels are measured and tested against."""
    before = _PLAIN.set(True)
    try:
        yield
    finally:
        _PLAIN.reset(before)
