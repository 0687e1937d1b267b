"""The committed figures of the viewer have the form that documents speak of, and what does not depend on the machine holds."""

import json
from pathlib import Path
from typing import Any

import pytest

FILE = Path(__file__).resolve().parents[2] / "benchmarks" / "results" / "viewer.json"


@pytest.fixture(scope="module")
def found() -> dict[str, Any]:
    if not FILE.is_file():
        pytest.skip("benchmarks/viewer_speed.py has not been run yet")
    whole: dict[str, Any] = json.loads(FILE.read_text())
    return whole


def test_every_part_says_how_busy_the_machine_was(found: dict[str, Any]) -> None:
    assert found["format"] == 1 and found["targets"] == {"start_seconds": 3.0, "drop_seconds": 0.5, "memory_ratio": 1.05}
    for name in {"start", "drop", "memory", "training"} & found.keys():
        assert found[name]["load_average_before"] >= 0 and found[name]["processors"] >= 1


@pytest.mark.parametrize(("part", "key"), [("start", "start_seconds"), ("drop", "drop_seconds")])
def test_times_stand_beside_their_targets(found: dict[str, Any], part: str, key: str) -> None:
    if part not in found:
        pytest.skip("not measured")
    row = found[part][key]
    assert 0 < row["median"] <= row["worst"] and row["count"] >= 5


def test_memory_stays(found: dict[str, Any]) -> None:
    if "memory" not in found:
        pytest.skip("not measured")
    row = found["memory"]
    assert row["moves"] == 200 and row["drops"] == 50 and row["faults"] == []
    assert row["memory_ratio"] <= found["targets"]["memory_ratio"]


def test_looking_changes_nothing(found: dict[str, Any]) -> None:
    if "training" not in found:
        pytest.skip("not measured")
    row = found["training"]
    assert row["nobody_bitwise_same"] and row["looked_at_bitwise_same"] and row["looked_at"]["pictures"] > 0
