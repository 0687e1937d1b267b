"""`benchmarks/fuzz.py`: readers that die, fall silent, fail and grow are told; what was done is gone on from."""

import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks import fuzz
from benchmarks.readers import Target
from benchmarks.readers import fuzz as fuzzed
from fprf.errors import DataError


@pytest.fixture
def script() -> ModuleType:
    return fuzz


def reader(folder: Path, act: Callable[[bytes], object]) -> Target:
    """Answers the valid file, refuses every second mutation, and acts on one in ten."""
    file = folder / "x"
    file.write_bytes(b"valid bytes of a file")

    def read() -> object:
        data = file.read_bytes()
        if data.startswith(b"valid bytes of a file"):
            return data
        if sum(data) % 10 == 0:
            return act(data)
        if sum(data) % 2:
            raise DataError("refused")
        return data

    return Target("x", file, read)


def test_a_reader_that_ends_its_process_is_told_and_gone_on_behind(script: ModuleType, tmp_path: Path) -> None:
    total = script.fresh()
    script.watch(reader(tmp_path, lambda data: os._exit(7)), total, 300, 0)
    assert total["faults"] == ["0 and on: the process ended with 7"] and total["rounds"] == 300
    assert (tmp_path / "x").read_bytes() == b"valid bytes of a file"


def test_parts_of_a_run_are_the_run(tmp_path: Path) -> None:
    """Also where only each sixteenth goes to the whole reader."""
    seen: list[str] = []
    file = tmp_path / "x"
    file.write_bytes(b"valid")
    target = Target(
        "x", file, lambda: seen.append(f"whole {file.read_bytes()!r}"), lambda: seen.append(f"{file.read_bytes()!r}")
    )
    fuzzed(target, 40, 1, quick=True)
    once, seen[:] = list(seen), []
    for first, count in ((0, 7), (7, 20), (27, 13)):
        fuzzed(target, count, 1, first=first, quick=True)
    assert seen == once and [k for k, line in enumerate(once) if line.startswith("whole")] == [0, 16, 32]
