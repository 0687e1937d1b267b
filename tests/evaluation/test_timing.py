import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fprf.evaluation.report import Watch, ratio, spread

CPU = torch.device("cpu")
SECONDS = st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=9)


@given(SECONDS)
def test_quartiles_surround_the_median_and_lie_within_the_values(values: list[float]) -> None:
    found = spread(values)
    assert min(values) <= found.low <= found.median <= found.high <= max(values) and found.rounds == len(values)


@given(SECONDS, st.floats(0.1, 50))
def test_load_that_both_meet_in_a_round_cancels(loads: list[float], faster: float) -> None:
    found = ratio([faster * load for load in loads], loads)
    for value in found[:3]:
        assert value == pytest.approx(faster)


def test_rounds_run_everything_in_turn_after_one_that_does_not_count() -> None:
    heard: list[str] = []
    told: list[tuple[int, int]] = []
    calls = {name: lambda name=name: heard.append(name) for name in "abc"}
    taken = Watch(4, CPU).in_turn(calls, lambda done, total: told.append((done, total)))
    assert "".join(heard) == "abc" + "abc" + "bca" + "cab" + "abc"
    assert {name: len(seconds) for name, seconds in taken.items()} == {"a": 4, "b": 4, "c": 4}
    assert told == [(0, 4), (1, 4), (2, 4), (3, 4), (4, 4)]
