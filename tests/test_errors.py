"""Errors are one line that a terminal can print, whatever the names in them are."""

import copy
import pickle

from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import CheckpointError, FprfError


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
