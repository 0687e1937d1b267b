"""Range checks: what passes, what does not, and that the sentence names field, value and range."""

from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from fprf.checks import at_least, between, positive
from fprf.errors import ConfigError

number = st.one_of(st.integers(), st.floats(allow_nan=False, allow_infinity=False))


def passes(check: Callable[[], None]) -> bool:
    try:
        check()
    except ConfigError:
        return False
    return True


@given(number)
def test_positive(value: float) -> None:
    assert passes(lambda: positive("x", value)) == (value > 0)


@given(number, number)
def test_at_least(value: float, low: float) -> None:
    assert passes(lambda: at_least("x", value, low)) == (value >= low)


@given(number, number, number)
def test_between(value: float, low: float, high: float) -> None:
    assert passes(lambda: between("x", value, low, high)) == (low <= value <= high)
