"""Range checks: what passes, what does not, and that the sentence names field, value and range."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.checks import at_least, between, positive
from fprf.errors import ConfigError

number = st.one_of(st.integers(), st.floats(allow_nan=False, allow_infinity=False))


CHECKS: list[Callable[[float], None]] = [
    lambda value: positive("field", value),
    lambda value: at_least("field", value, -1e308),
    lambda value: between("field", value, -1e308, 1e308),
]


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


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_never_passes(check: Callable[[float], None], value: float) -> None:
    with pytest.raises(ConfigError, match=r"field: .* is not a finite number"):
        check(value)
