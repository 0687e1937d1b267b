"""Types of the page's scripts, which their JSDoc says, by the TypeScript compiler where there is one."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_scripts_keep_the_types_that_they_name() -> None:
    compiler = os.environ.get("FPRF_TSC") or shutil.which("tsc")
    if compiler is None:
        pytest.skip("no tsc on this machine: npm install --global typescript, or name one in FPRF_TSC")
    if not (ROOT / "tsconfig.json").is_file():
        pytest.skip("an installed package has no tsconfig.json")
    found = subprocess.run(
        [compiler, "--project", "tsconfig.json"], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert found.returncode == 0, found.stdout
