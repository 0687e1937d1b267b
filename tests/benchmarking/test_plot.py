import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.benchmarking.front import Point
from fprf.benchmarking.plot import HEIGHT, WIDTH, Panel, draw, ticks
from fprf.benchmarking.timing import Spread


def made(errors: list[float]) -> list[Point]:
    return [
        Point(
            knob=f"knob {i % 3}", value=str(i), seconds=Spread(0.01 * (i + 1), 0.01, 0.2, 3), rays_per_second=1.0,
            largest=error, rms=error,
        )
        for i, error in enumerate(errors)
    ]  # fmt: skip


def panel(errors: list[float], *, log: bool = True) -> Panel:
    points = made(errors)
    return Panel("title", points, points[:2], lambda p: p.rms, "error", log=log)


@given(st.floats(1e-9, 1e6), st.floats(1.01, 1e7))
def test_logarithmic_ticks_are_few_round_and_within(low: float, times: float) -> None:
    found = ticks(low, low * times, log=True)
    assert 1 <= len(found) <= 8 and found == sorted(found)
    assert all(low * (1 - 1e-9) <= t <= low * times * (1 + 1e-9) for t in found)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
def test_even_ticks_are_few_even_and_within(low: float, width: float) -> None:
    found = ticks(low, low + width, log=False)
    slack = 1e-6 * (abs(low) + width)
    assert 2 <= len(found) <= 9 and all(low - slack <= t <= low + width + slack for t in found)
    steps = np.diff(found)
    assert steps.max() - steps.min() <= slack


@pytest.mark.parametrize(("panels", "rows", "columns"), [(0, 1, 1), (1, 1, 1), (2, 1, 2), (3, 2, 2)])
def test_panels_stand_two_by_two(panels: int, rows: int, columns: int) -> None:
    picture = draw([panel([0.1, 0.01, 0.5])] * panels)
    assert picture.shape == (rows * HEIGHT, columns * WIDTH, 3) and picture.dtype == np.uint8
    assert bool(picture.std() > 5) is (panels > 0)


def test_every_point_is_drawn_in_the_colour_of_its_knob() -> None:
    few, more = draw([panel([0.1, 0.2])]), draw([panel([0.1, 0.2, 0.05])])
    assert (few != more).any()
    coloured = (np.ptp(more.astype(int), axis=2) > 60).sum()
    assert coloured > (np.ptp(few.astype(int), axis=2) > 60).sum() > 50


@pytest.mark.parametrize("errors", [[0.0, 0.0], [0.1], [1e-12, 1.0], [3.0, 3.0, 3.0]])
@pytest.mark.parametrize("log", [True, False])
def test_degenerate_points_have_axes_too(errors: list[float], log: bool) -> None:
    assert draw([panel(errors, log=log)]).std() > 5


def test_many_points_in_one_place_leave_out_names_but_no_points() -> None:
    assert draw([panel([0.1] * 60)]).shape == (HEIGHT, WIDTH, 3)
