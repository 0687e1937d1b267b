import json

import pytest
import torch

from fprf.evaluation.report import Row, Spread, document, falls_short

CPU = torch.device("cpu")


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


def test_a_document_names_what_falls_short_and_the_machine() -> None:
    rows = [Row(name="good", figure=1.0, unit="s", goal=2.0), Row(name="bad", figure=3.0, unit="s", goal=2.0)]
    made = document("speed", rows, device=CPU, settings={"a": 1}, extra={"counters": {"kept": 0.5}})
    assert json.loads(json.dumps(made)) == made
    assert made["falls_short"] == falls_short(rows) == ["bad"]
    assert (made["benchmark"], made["settings"], made["counters"]) == ("speed", {"a": 1}, {"kept": 0.5})
    assert made["machine"]["device"] == "cpu" and made["machine"]["torch"] == torch.__version__
