import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.benchmarking.scaling import Series, exponent
from fprf.benchmarking.timing import Spread


@given(st.lists(st.integers(1, 10**6), min_size=2, max_size=6, unique=True), st.floats(-2, 3), st.floats(0.01, 100))
def test_a_power_is_found_again(sizes: list[int], power: float, factor: float) -> None:
    assert exponent(sizes, [factor * size**power for size in sizes]) == pytest.approx(power, abs=1e-6)


@pytest.mark.parametrize("sizes", [[], [5], [5, 5]])
def test_one_size_has_no_power(sizes: list[int]) -> None:
    assert exponent(sizes, [1.0] * len(sizes)) is None


def test_costs_that_do_not_grow() -> None:
    assert exponent([1, 10, 100], [3.0, 3.0, 3.0]) == pytest.approx(0)


def test_json_of_a_series() -> None:
    series = Series("a view", "pixels", (10, 100), (Spread(1.0, 0.5, 2.0, 3), Spread(10.0, 9.0, 11.0, 3)))
    document = series.json()
    assert document["exponent"] == pytest.approx(1) and document["milliseconds"] == [1.0, 10.0]
    assert (document["low"], document["high"], document["sizes"]) == ([0.5, 9.0], [2.0, 11.0], [10, 100])
