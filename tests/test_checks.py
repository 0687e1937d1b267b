"""Range checks: what passes, what does not, and that the sentence names field, value and range."""

import math
import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.checks import at_least, between, positive
from fprf.errors import ConfigError, FprfError

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


@pytest.mark.parametrize("sign", [1, -1])
def test_integers_beyond_any_float_are_compared_as_they_are(sign: int) -> None:
    huge = sign * 10**400
    assert passes(lambda: positive("x", huge)) == (sign > 0)
    assert passes(lambda: at_least("x", huge, 3)) == (sign > 0)
    assert not passes(lambda: between("x", huge, 0, 5))


@pytest.mark.parametrize(
    ("check", "sentence"),
    [
        (lambda: positive("optimizer.rate", 0), "optimizer.rate: 0 must be above 0"),
        (lambda: at_least("steps", 0, 1), "steps: 0 must be at least 1"),
        (lambda: between("strength", 1.5, 0, 1), "strength: 1.5 must lie in [0, 1]"),
    ],
)
def test_the_sentence_names_field_value_and_range(check: Callable[[], None], sentence: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(sentence)}$") as caught:
        check()
    assert isinstance(caught.value, FprfError)
