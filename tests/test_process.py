"""What the command line asks of its process: freed memory does not fault again."""

import subprocess
import sys

import pytest

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
    ended = subprocess.run([sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=True, timeout=60)
    return ended.stdout.strip()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks the GNU C library")
def test_freed_memory_is_not_cleared_again() -> None:
    """Five times 100 MB in pieces: thousands of pages by default, hardly one once they are kept."""
    kept = faults("kept")
    if kept == "refused":
        pytest.skip("not the GNU C library")
    assert int(kept) < 100 < int(faults("default"))
