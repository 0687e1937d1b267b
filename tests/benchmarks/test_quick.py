"""Every benchmark the whole way, small: what nobody runs, rots."""

import importlib.util

import pytest

from benchmarks.__main__ import BENCHMARKS, main


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", BENCHMARKS)
def test_it_runs(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    for package in BENCHMARKS[name].packages:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    assert main([name, "--quick"]) == 0
    assert capfd.readouterr().err.startswith(f"{name} needs ")
