from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.config import OptimizerConfig, TrainConfig
from fprf.training.loop import progress, rate


def config(steps: int, minutes: float | None = None) -> TrainConfig:
    return replace(TrainConfig(), steps=steps, minutes=minutes)


@pytest.mark.parametrize(
    ("steps", "minutes", "step", "seconds", "share"),
    [
        (100, None, 0, 0.0, 0.0),
        (100, None, 25, 1e9, 0.25),
        (100, None, 100, 0.0, 1.0),
        (100, None, 999, 0.0, 1.0),
        (100, 1.0, 25, 12.0, 0.25),
        (100, 1.0, 25, 30.0, 0.5),
        (100, 1.0, 0, 61.0, 1.0),
        (100, 1.0, 100, 0.0, 1.0),
        (0, None, 0, 0.0, 1.0),
        (0, 5.0, 0, 0.0, 1.0),
    ],
)
def test_whichever_comes_first_ends(steps: int, minutes: float | None, step: int, seconds: float, share: float) -> None:
    assert progress(config(steps, minutes), step, seconds) == pytest.approx(share, abs=1e-12)


@given(st.integers(1, 10**6), st.integers(0, 10**6), st.floats(0, 1e6), st.floats(0, 1e6))
def test_progress_only_rises(steps: int, step: int, early: float, late: float) -> None:
    of = config(steps, 3.0)
    early, late = sorted((early, late))
    assert 0 <= progress(of, step, early) <= progress(of, step, late) <= 1
    assert progress(of, step, early) <= progress(of, step + 1, early)


def test_the_rate_warms_up_then_falls_to_its_end() -> None:
    of = OptimizerConfig(rate=0.5, final=0.1, warm_up=10)
    assert [rate(of, step, 0.0) for step in (0, 4, 9, 10, 500)] == pytest.approx([0.05, 0.25, 0.5, 0.5, 0.5])
    assert rate(of, 500, 1.0) == pytest.approx(0.05)
    assert rate(of, 500, 0.5) == pytest.approx(0.5 * 0.55)


@given(st.integers(0, 10**6), st.floats(0, 1), st.floats(0, 1), st.integers(0, 1000))
def test_the_rate_stays_within_its_bounds(step: int, share: float, final: float, warm_up: int) -> None:
    of = OptimizerConfig(rate=0.02, final=final, warm_up=warm_up)
    found = rate(of, step, share)
    assert 0 <= found <= 0.02 * (1 + 1e-12)
    assert found >= rate(of, step, min(1.0, share + 0.1)) - 1e-15
    if step >= warm_up:
        assert found >= 0.02 * final * (1 - 1e-12)
