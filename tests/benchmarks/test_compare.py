"""Two results side by side: what counts as lost."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.compare import changes, main
from fprf.errors import DataError

MACHINE = {"processor": "x", "cores": 2, "threads": 2, "device": "cpu"}


def result(*rows: dict[str, Any], **others: Any) -> dict[str, Any]:
    return {"benchmark": "speed", "settings": {}, "machine": MACHINE, "rows": list(rows), **others}


def row(name: str = "render", figure: float = 100.0, unit: str = "rays/s", **others: Any) -> dict[str, Any]:
    return {"name": name, "figure": figure, "unit": unit, **others}


def faults(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    return [each.fault for each in changes(old, new, loss=0.1, error=1.5)]


def test_a_tenth_less_is_lost_and_less_than_that_is_not() -> None:
    old = result(row(ratio=4.0))
    assert faults(old, result(row(figure=91.0, ratio=3.61))) == [""]
    assert faults(old, result(row(figure=89.0, ratio=3.59))) == ["slower"]


def test_times_count_the_other_way() -> None:
    old = result(row(figure=10.0, unit="ms"))
    assert faults(old, result(row(figure=11.0, unit="ms"))) == [""]
    assert faults(old, result(row(figure=11.2, unit="ms"))) == ["worse"]


def test_a_faster_peer_loses_nothing_and_neither_does_a_slower_machine() -> None:
    old = result(row(ratio=4.0))
    assert faults(old, result(row(figure=100.0, ratio=2.0))) == [""]
    assert faults(old, result(row(figure=50.0, ratio=4.0))) == [""]
    other = result(row(figure=100.0, ratio=2.0), machine=MACHINE | {"cores": 4})
    assert faults(old, other) == ["slower"]
    assert faults(result(row()), result(row(figure=1.0), machine=MACHINE | {"cores": 4})) == [""]


def test_errors_and_rows_that_are_gone() -> None:
    old = result(row(ratio=4.0, error=1e-3), row(name="train", ratio=6.0))
    (grown, gone) = faults(old, result(row(ratio=4.0, error=1.6e-3)))
    assert grown == "error 0.001 to 0.002"
    assert gone == "gone"


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = tmp_path / "old.json"
    new = tmp_path / "new.json"
    old.write_text(json.dumps(result(row(ratio=4.0))))
    new.write_text(json.dumps(result(row(figure=50.0, ratio=2.0), settings={"rounds": 3})))
    assert main([str(old), str(old)]) == 0
    assert main([str(old), str(new)]) == 1
    said = capsys.readouterr().err
    assert "lost: render" in said
    assert "settings differ: rounds was None, is 3" in said
    assert main([str(old), str(new), "--loss", "0.6"]) == 0


@pytest.mark.parametrize("text", ["", "[]", '{"rows": [1]}', '{"rows": [{"name": "x"}]}'])
def test_what_is_no_result_is_said(tmp_path: Path, text: str) -> None:
    bad = tmp_path / "bad.json"
    bad.write_text(text)
    with pytest.raises(DataError, match=r"bad\.json"):
        main([str(bad), str(bad)])
    with pytest.raises(DataError, match="No such file"):
        main([str(tmp_path / "none.json"), str(bad)])


def test_results_of_two_benchmarks_are_not_compared() -> None:
    with pytest.raises(DataError, match="one benchmark"):
        changes(result(row()), result(row()) | {"benchmark": "gaussians"}, loss=0.1, error=1.5)
