"""Memory: what is freed is kept; where there is too little, less is taken at once if that gives the same,
else told.

Every library says it differently: Python and NumPy raise MemoryError, torch a RuntimeError on the CPU and one
of its own on a GPU, OpenCV its error -4. None of them is imported here.

By default the system takes what is freed back. A step frees and asks for the same tens of megabytes again,
and each page that comes back is cleared anew: a tenth of a training step. So freed memory stays with the
process, up to `TRIM` bytes.
"""

import ctypes
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from .errors import OutOfMemoryError

if TYPE_CHECKING:
    import torch

LEAST = 1024
"""Rays below which parts are not halved: their share of the memory is small beside the model's."""
_RAY = 192 << 10
"""Bytes a ray on an accelerator, at most: in plain torch `fprf` with nothing skipped takes 173 KiB,
`fprf-lite` 21.
"""
_SHARE = 0.5
"""Of an accelerator's free memory, what a chunk of rays may take."""
_TEXT = re.compile(
    r"can't allocate memory|not enough memory|Cannot allocate memory|Tried to allocate|out of memory|bad_alloc|_ALLOC_FAILED"
)
_GPU = re.compile(r"GPU \d+ has a total capacity of [\d.]+ \w+ of which [\d.]+ \w+ is free")
_ASKED = re.compile(r"(?:allocate|allocate array of|llocate) ([\d.]+) (bytes|KiB|MiB|GiB|TiB)", re.IGNORECASE)
_UNITS = {"bytes": 1, "kib": 1 << 10, "mib": 1 << 20, "gib": 1 << 30, "tib": 1 << 40}
"""Bytes of the units that such texts name."""
_OPENCV_NO_MEMORY = -4
"""Code of OpenCV's error StsNoMem."""
TRIM = 2**29
"""Freed memory beyond this goes back to the system."""
_LARGEST = (2**27, 2**25)
"""Pieces up to this size come from memory that was freed before; older C libraries refuse more than the
second.
"""
_TRIM_THRESHOLD = -1
"""M_TRIM_THRESHOLD of mallopt (glibc's malloc.h)."""
_MMAP_THRESHOLD = -3
"""M_MMAP_THRESHOLD of mallopt."""
_GIB = 1 << 30
"""Bytes of a GiB."""
_Found = TypeVar("_Found")


def keep_memory() -> bool:
    """Ask the C library to keep what is freed, unless the user decided otherwise; False where it is not
    GNU's.
    """
    if not sys.platform.startswith("linux") or any(name.startswith("MALLOC_") for name in os.environ):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return False
    return any(mallopt(_MMAP_THRESHOLD, size) for size in _LARGEST) and bool(mallopt(_TRIM_THRESHOLD, TRIM))


def out_of_memory(error: BaseException) -> bool:
    """True for an error of memory that could not be allocated."""
    if isinstance(error, MemoryError):
        return True
    if getattr(error, "code", None) == _OPENCV_NO_MEMORY and type(error).__module__ == "cv2":
        return True
    if (
        isinstance(error, SystemError) and error.__cause__ is not None
    ):  # numba's, of an error in a parallel loop
        return out_of_memory(error.__cause__)
    return isinstance(error, RuntimeError) and _TEXT.search(str(error)) is not None


def wanted(error: BaseException) -> int | None:
    """The bytes that could not be had, where the error tells."""
    match = _ASKED.search(str(error))
    if match is None:
        return None
    return int(float(match[1]) * _UNITS[match[2].lower()])


def in_parts(count: int, size: int, work: Callable[[slice], _Found]) -> Iterator[_Found]:
    """`work` of one slice after the other that together are `count` things, `size` at a time; half as many,
    down to LEAST, from where there was not enough memory on. What is worked out of a thing must not depend on
    the others.

    Raises OutOfMemoryError where there is not enough for LEAST either.
    """
    start = 0
    while start < count:
        try:
            result = work(slice(start, start + size))
        except Exception as error:
            if not out_of_memory(error):
                raise
            if size <= LEAST:
                raise shortage(f"{size} rays at a time", error, "close other programs") from error
            size = max(LEAST, size // 2)
        else:
            yield result
            start += size


def chunk_size(size: int, device: "torch.device") -> int:
    """Rays to render at a time: `size` on the CPU; on an accelerator what half of its free memory holds, at
    least `size`.
    """
    free = free_memory(device)
    if free is None:
        return size
    return max(size, int(_SHARE * free) // _RAY)


def free_memory(device: "torch.device") -> int | None:
    """Free bytes of an accelerator; None for the CPU, and for other kinds of device."""
    if device.type == "cuda":
        from torch import cuda

        return cuda.mem_get_info(device)[0] + cuda.memory_reserved(device) - cuda.memory_allocated(device)
    if device.type == "mps":
        from torch import mps

        return max(0, mps.recommended_max_memory() - mps.driver_allocated_memory())
    return None


def shortage(what: str, error: BaseException, remedy: str) -> OutOfMemoryError:
    """One line: what was going on, what it took, what there is, and what to do."""
    more = wanted(error)
    held = peak()
    card = _GPU.search(str(error))
    if card is not None:  # what the process and the machine have says nothing of it
        if more is None:
            asked = ""
        else:
            asked = f", {more / _GIB:.2f} GiB more were wanted"
        return OutOfMemoryError(f"{what}: not enough memory{asked} ({card[0]}); {remedy}")
    if more is None:
        asked = ""
    else:
        asked = f" and wanted {more / _GIB:.2f} GiB more"
    if held is None:
        took = ""
    else:
        took = f"; the process held up to {held / _GIB:.2f} GiB{asked}"
    # Free memory and the process's limit, as far as the system tells.
    limits = []
    free = available_memory()
    if free is not None:
        limits.append(f"{free / _GIB:.2f} GiB are free on this machine")
    if os.name == "posix":
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            limits.append(f"{limit / _GIB:.2f} GiB of addresses are allowed")
    known = f" ({', '.join(limits)})" if limits else ""
    return OutOfMemoryError(f"{what}: not enough memory{took}{known}; {remedy}")


def available_memory() -> int | None:
    """Bytes of this machine's memory that are free or can be freed; None where the system does not tell."""
    try:
        available = re.search(r"MemAvailable:\s+(\d+)", Path("/proc/meminfo").read_text())
    except OSError:
        return None
    return None if available is None else int(available[1]) * 1024


def peak() -> int | None:
    """Most bytes that this process ever held; None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kib if sys.platform == "darwin" else kib * 1024
