"""Range checks: what passes, what does not, and that the sentence names field, value and range."""

import copy
import math
import pickle
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.checks import at_least, between, positive
from fprf.errors import CheckpointError, ConfigError, FprfError

number = st.one_of(st.integers(), st.floats(allow_nan=False, allow_infinity=False))


def passes(check: Callable[[], None]) -> bool:
    try:
        check()
    except ConfigError:
        return False
    return True


@given(number, number, number)
def test_what_passes(value: float, low: float, high: float) -> None:
    assert passes(lambda: positive("x", value)) == (value > 0)
    assert passes(lambda: at_least("x", value, low)) == (value >= low)
    assert passes(lambda: between("x", value, low, high)) == (low <= value <= high)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_never_passes(value: float) -> None:
    for check in (lambda: positive("x", value), lambda: at_least("x", value, -1e308), lambda: between("x", value, 0, 1e308)):
        assert not passes(check)


@given(st.text())
def test_a_text_is_one_printable_line(text: str) -> None:
    said = str(FprfError(text))
    assert said.isprintable() and (said == text or not text.isprintable())


def test_line_breaks_and_escapes_of_a_terminal_are_spelled_out() -> None:
    assert str(CheckpointError("a\nb\x1b[2J\udcff")) == "a\\nb\\x1b[2J\\udcff"
    assert str(CheckpointError("süß 街道 1 °")) == "süß 街道 1 °"


def test_an_error_survives_the_way_between_processes() -> None:
    error = CheckpointError("a\nb")
    for other in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert type(other) is CheckpointError and str(other) == "a\\nb"
