import io
import json

import pytest
import torch
from rich.console import Console

from fprf.evaluation.report import Row, Spread, document, falls_short, machine, rows_table, table

CPU = torch.device("cpu")


def shown(made: object) -> str:
    out = io.StringIO()
    Console(file=out, width=140, highlight=False).print(made)
    return out.getvalue()


@pytest.mark.parametrize(
    ("goal", "more", "met"),
    [(None, False, True), (3.0, False, True), (2.0, False, True), (1.9, False, False), (2.0, True, True), (2.1, True, False)],
)
def test_a_goal_is_met_at_its_edge(goal: float | None, more: bool, met: bool) -> None:
    assert Row(name="x", figure=2.0, unit="s", goal=goal, more_is_better=more).met is met


@pytest.mark.parametrize(("median", "met"), [(8.0, True), (7.9, False), (None, False)])
def test_a_ratio_has_a_goal_of_its_own(median: float | None, met: bool) -> None:
    ratio = None if median is None else Spread(median, 1.0, 9.0, 3)
    assert Row(name="x", figure=2.0, unit="s", ratio=ratio, ratio_goal=8.0).met is met


def test_both_goals_count() -> None:
    fast = Spread(9.0, 8.0, 10.0, 3)
    assert not Row(name="x", figure=2.0, unit="s", goal=1.0, ratio=fast, ratio_goal=8.0).met


def test_json_says_what_is_known_and_nothing_else() -> None:
    row = Row(name="x", figure=1.23456789, unit="s")
    assert row.json() == {"name": "x", "figure": 1.2346, "unit": "s"}
    full = Row(
        name="y", figure=2, unit="ms", low=1.0, high=3.0, goal=1.0, peer=4.0, ratio=Spread(2.0, 1.5, 2.5, 5), ratio_goal=3.0,
        error=1e-3, error_kind="largest", peer_error=0.0, note="n",
    )  # fmt: skip
    assert full.json() == {
        "name": "y", "figure": 2, "unit": "ms", "low": 1.0, "high": 3.0, "goal": 1.0, "peer": 4.0, "ratio_goal": 3.0,
        "error": 1e-3, "peer_error": 0.0, "goal_is": "at most", "ratio": 2.0, "ratio_low": 1.5, "ratio_high": 2.5,
        "error_kind": "largest", "note": "n",
    }  # fmt: skip


def test_a_document_names_what_falls_short_and_the_machine() -> None:
    rows = [Row(name="good", figure=1.0, unit="s", goal=2.0), Row(name="bad", figure=3.0, unit="s", goal=2.0)]
    made = document("speed", rows, device=CPU, settings={"a": 1}, extra={"counters": {"kept": 0.5}})
    assert json.loads(json.dumps(made)) == made
    assert made["falls_short"] == falls_short(rows) == ["bad"]
    assert (made["benchmark"], made["settings"], made["counters"]) == ("speed", {"a": 1}, {"kept": 0.5})
    assert made["machine"]["device"] == "cpu" and made["machine"]["torch"] == torch.__version__


def test_the_machine_is_not_named() -> None:
    import platform

    name = platform.node()
    assert name not in machine(CPU).values()


def test_a_table_of_rows() -> None:
    rows = [
        Row(name="[train]", figure=12345.0, unit="rays/s", low=11111.0, high=13580.0, peer=1000.0,
            ratio=Spread(12.3, 12.0, 13.0, 5), ratio_goal=100.0, error=1.5e-3),
        Row(name="style", figure=0.2, unit="s", goal=1.0),
    ]  # fmt: skip
    text = shown(rows_table("speed", rows))
    for part in ("[train]", "12,345 rays/s", "± 10 %", "1,000", "12.30 ×", "1.5e-03", "≥ 100 ×", "0.200 s", "≤ 1.00"):
        assert part in text, part
    assert "falls short: [train]" in text


def test_a_table_without_peers_has_no_column_for_them() -> None:
    text = shown(rows_table("memory", [Row(name="x", figure=5.0, unit="MiB")]))
    assert "peer" not in text and "falls short" not in text and "5.00 MiB" in text


def test_markup_in_cells_is_text() -> None:
    assert "[red]x" in shown(table("t", ("a",), [["[red]x"]]))
