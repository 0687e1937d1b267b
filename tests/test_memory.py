"""What libraries say when memory is short, parts that get smaller, the one line at the end; freed memory is
kept.
"""

import subprocess
import sys

import cv2
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pretend_cuda import pretend_cuda

from fprf.errors import OutOfMemoryError
from fprf.memory import LEAST, chunk_size, free_memory, in_parts, out_of_memory, wanted

TORCH = "[enforce fail at alloc_cpu.cpp:127] . DefaultCPUAllocator: can't allocate memory: you tried to allocate 4096 bytes."
CUDA = "CUDA out of memory. Tried to allocate 1.50 GiB. GPU 0 has a total capacity of 79 GiB of which 1 GiB is free."


def opencv(code: int) -> cv2.error:
    error = cv2.error(
        "OpenCV(5.0.0): error: Failed to allocate 2700000000 bytes in function 'OutOfMemoryError'"
    )
    error.code = code
    return error


def caused(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "short", "bytes_"),
    [
        (MemoryError("Unable to allocate 8.00 GiB for an array with shape (1073741824,)"), True, 8 << 30),
        (MemoryError(), True, None),
        (RuntimeError(TORCH), True, 4096),
        (torch.OutOfMemoryError(CUDA), True, 3 << 29),
        (
            RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
            True,
            None,
        ),
        (RuntimeError("std::bad_alloc"), True, None),
        (opencv(-4), True, 2_700_000_000),
        (opencv(-215), False, 2_700_000_000),
        (caused(SystemError("returned a result with an exception set"), MemoryError()), True, None),
        (SystemError("something else"), False, None),
        (RuntimeError("sizes do not match"), False, None),
        (ValueError("out of memory"), False, None),
        (KeyboardInterrupt(), False, None),
    ],
)
def test_what_each_library_says(error: BaseException, short: bool, bytes_: int | None) -> None:
    assert out_of_memory(error) is short
    assert wanted(error) == bytes_


@settings(deadline=None)
@given(st.integers(0, 20_000), st.integers(500, 9000), st.integers(1, 9000))
def test_everything_is_done_once_and_in_order_whatever_fits(count: int, size: int, fits: int) -> None:
    tried: list[int] = []

    def work(part: slice) -> list[int]:
        found = list(range(count))[part]
        tried.append(part.stop - part.start)
        if len(found) > max(fits, LEAST):
            raise MemoryError
        return found

    found = list(in_parts(count, size, work))
    assert [each for part in found for each in part] == list(range(count))
    assert tried == sorted(tried, reverse=True), "once smaller, always smaller"
    assert all(part >= min(size, LEAST) for part in tried)
    assert all(
        tried.count(part) >= 1 and part in {max(LEAST, size >> k) for k in range(20)} | {size}
        for part in tried
    )


def test_other_errors_and_too_little_for_the_least_are_raised() -> None:
    def broken(part: slice) -> None:
        raise ZeroDivisionError

    def short(part: slice) -> None:
        tried.append(part.stop - part.start)
        raise RuntimeError(TORCH)

    with pytest.raises(ZeroDivisionError):
        list(in_parts(5, 2, broken))
    tried: list[int] = []
    with pytest.raises(
        OutOfMemoryError, match=r"1024 rays at a time: not enough memory; .* wanted 0.00 GiB more"
    ):
        list(in_parts(10_000, 5000, short))
    assert tried == [5000, 2500, 1250, 1024]
    with pytest.raises(OutOfMemoryError, match="300 rays at a time"):
        list(in_parts(300, 300, short))


def test_chunks_follow_the_memory_of_an_accelerator_alone() -> None:
    cpu = torch.device("cpu")
    cuda = torch.device("cuda:0")
    assert chunk_size(8192, cpu) == 8192 and free_memory(cpu) is None
    with pretend_cuda(memory=24 << 30):
        assert free_memory(cuda) == 24 << 30
        assert chunk_size(8192, cuda) == (12 << 30) // (192 << 10)
    with pretend_cuda(memory=1 << 20):
        assert chunk_size(8192, cuda) == 8192, "too large a chunk is halved when memory is short"


FAULTS = """
import resource, sys
if sys.argv[1] == "kept":
    from fprf.memory import keep_memory
    if not keep_memory():
        print("refused"); sys.exit()
import numpy
def use():
    for _ in range(5):
        together = [numpy.ones(2_500_000) for _ in range(5)]
        del together
use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
use()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> str:
    ended = subprocess.run(
        [sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=True, timeout=60
    )
    return ended.stdout.strip()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks the GNU C library")
def test_freed_memory_is_not_cleared_again() -> None:
    """Five times 100 MB in pieces: thousands of pages by default, hardly one once they are kept."""
    kept = faults("kept")
    if kept == "refused":
        pytest.skip("not the GNU C library")
    assert int(kept) < 100 < int(faults("default"))
