"""Configuration of the command line's process, before anything heavy is imported.

Threads that wait for others give way soon. By default OpenMP's spin for milliseconds, and where another program uses the
cores they spin instead of those that they wait for: with 20 busy programs on two cores a training step took 2304 ms,
and 236 ms with this; alone on the cores it costs a twentieth.

Memory that is freed stays with the process, up to `TRIM` bytes. A step frees and asks for the same tens of megabytes again,
and each page that comes back from the system is cleared anew: a tenth of a training step.
"""

import ctypes
import os
import sys
from collections.abc import MutableMapping

SPINS = "1000"
"""Rounds that a waiting thread spins for GNU's OpenMP: some 20 microseconds."""
BLOCK_MS = "0"
"""Milliseconds that it spins for LLVM's."""
TRIM = 2**29
"""Freed memory beyond this goes back to the system."""
LARGEST = 2**27
"""Pieces up to this size come from memory that was freed before."""
OLDER = 2**25
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3


def configure_process() -> None:
    """Configure waiting threads, memory and OpenCV's log, unless the user decided otherwise."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "FATAL")  # else damaged images are told twice: by it, and by us in one line
    wait_briefly(os.environ)
    keep_memory()


def wait_briefly(environment: MutableMapping[str, str]) -> None:
    """Ask OpenMP, which reads the environment when it is loaded, to spin briefly; what the user set stays."""
    if "OMP_WAIT_POLICY" not in environment:
        environment.setdefault("GOMP_SPINCOUNT", SPINS)
        environment.setdefault("KMP_BLOCKTIME", BLOCK_MS)


def keep_memory() -> bool:
    """Ask the C library to keep what is freed; False where it is not GNU's."""
    if not sys.platform.startswith("linux") or any(name.startswith("MALLOC_") for name in os.environ):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return False
    # Older versions refuse more than OLDER.
    return any(mallopt(_MMAP_THRESHOLD, size) for size in (LARGEST, OLDER)) and bool(mallopt(_TRIM_THRESHOLD, TRIM))
