"""What the command line asks of its process: what the user set stays, and freed memory does not fault again."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fake_packages import packages_in

from fprf.process import BLOCK_MS, SPINS, wait_briefly

FAULTS = """
import resource, sys
if sys.argv[1] == "kept":
    from fprf.process import keep_memory
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


def test_waiting_threads_spin_briefly() -> None:
    environment: dict[str, str] = {}
    wait_briefly(environment)
    assert environment == {"GOMP_SPINCOUNT": SPINS, "KMP_BLOCKTIME": BLOCK_MS}


@pytest.mark.parametrize("given", [{"OMP_WAIT_POLICY": "active"}, {"GOMP_SPINCOUNT": "7", "KMP_BLOCKTIME": "9"}])
def test_what_the_user_set_stays(given: dict[str, str]) -> None:
    environment = dict(given)
    wait_briefly(environment)
    assert environment == given


DAMAGED = """
import sys
from importlib import metadata
from fprf.process import entry_points_of, settle, spare_others

def outcome(ask):
    try:
        return len(list(ask()))
    except Exception as error:
        return type(error).__name__

damaged = next(d for d in metadata.distributions(path=[sys.argv[1]]) if d.name == "acme-damaged")
print(outcome(metadata.entry_points))
settle()
spare_others()
print(outcome(lambda: damaged.entry_points), outcome(lambda: entry_points_of(damaged)))
print(outcome(metadata.entry_points))
"""


def test_a_damaged_package_is_passed_over_by_everybody_but_us(tmp_path: Path) -> None:
    with packages_in(tmp_path) as packages:
        packages.raw("acme-damaged", "[fprf.encoders]\nno equals sign\n")
    words = [sys.executable, "-c", DAMAGED, str(tmp_path)]
    ended = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ | {"PYTHONPATH": str(tmp_path)})
    before, (without, ours), after = (
        ended.stdout.splitlines()[0],
        ended.stdout.splitlines()[1].split(),
        ended.stdout.split()[-1],
    )
    assert before == "TypeError" and without == "0" and ours == "TypeError" and int(after) > 0
