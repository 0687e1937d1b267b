"""No kernel reads or writes beside its arrays: its tests, compiled with every index checked."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
KERNELS = ("dense", "guided", "rasterise", "triplane")


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_no_index_leaves_its_array(tmp_path: Path) -> None:
    files = [str(HERE / f"test_{name}.py") for name in KERNELS]
    settings = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files]
    done = subprocess.run(command, env=os.environ | settings, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert any(tmp_path.rglob("*.nbc")), "compiled anew, with the checks"
