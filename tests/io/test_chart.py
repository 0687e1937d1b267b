import math
import re
import xml.etree.ElementTree as ET
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.io.report import Series, bars, lines, spark, ticks

EVIL = """<script>"'&"""


@settings(deadline=None)
@given(st.floats(-1e3, 1e3), st.floats(1e-2, 1e6), st.integers(2, 9))
def test_ticks_are_round_even_and_inside(low: float, span: float, most: int) -> None:
    found = ticks(low, low + span, most)
    assert 1 <= len(found) <= most + 1 or not found
    slack = 1e-6 * (abs(low) + span)
    assert all(low - slack <= value <= low + span + slack for value in found)
    steps = {round((b - a) / 10 ** math.floor(math.log10(b - a) + 1e-6)) for a, b in pairwise(found)}
    assert steps <= {1, 2, 5, 10} and len(steps) <= 1


def test_ticks_by_hand() -> None:
    assert ticks(0, 10) == [0, 2, 4, 6, 8, 10] and ticks(3, 3) == [3]
    assert ticks(0.12, 0.39) == pytest.approx([0.2, 0.3])


def drawn(text: str) -> tuple[ET.Element, list[list[tuple[float, float]]]]:
    whole = ET.fromstring(text)
    lines = [
        [(float(x), float(y)) for x, y in (pair.split(",") for pair in line.attrib["points"].split())]
        for line in whole.iter("polyline")
    ]
    return whole, lines


def test_points_lie_where_their_numbers_say() -> None:
    text = lines("A", [Series("a", [0, 5, 10], [0.0, 10.0, 5.0])], "step", "dB")
    whole, ((first, top, last),) = drawn(text)
    assert first[0] < top[0] < last[0] and top[0] - first[0] == pytest.approx(last[0] - top[0], abs=0.11)
    assert first[1] > last[1] > top[1], "up is more"
    assert first[1] - last[1] == pytest.approx(last[1] - top[1], abs=0.11)
    _, _, width, height = map(float, whole.find("svg").attrib["viewBox"].split())  # type: ignore[union-attr]
    assert all(0 <= x <= width and 0 <= y <= height for x, y in (first, top, last))
    assert [label.text for label in whole.iter("text")][-1] == "step" and "A, dB" in text


def test_logarithms_space_by_factors_and_leave_out_nothing_else() -> None:
    _, (points,) = drawn(lines("A", [Series("a", [0, 1, 2, 3, 4], [1.0, 0.1, 0.0, None, 0.01])], "step", "", log=True))
    assert len(points) == 3
    assert points[1][1] - points[0][1] == pytest.approx(points[2][1] - points[1][1], abs=0.11)


def test_many_points_are_thinned_and_the_last_one_stays() -> None:
    _, (points,) = drawn(lines("A", [Series("a", range(5001), [float(k) for k in range(5001)])], "step", ""))
    assert len(points) <= 401 and points[-1][1] == min(y for _, y in points)


def test_several_lines_have_a_legend_and_one_has_none() -> None:
    one, two = Series("a", [0, 1], [1.0, 2.0]), Series(EVIL, [0, 1], [2.0, 2.0])
    whole, found = drawn(lines(EVIL, [one, two], EVIL, EVIL))
    assert len(found) == 2 and len(list(whole.iter("li"))) == 2
    assert len({line.attrib["stroke"] for line in whole.iter("polyline")}) == 2
    assert not list(drawn(lines("A", [one], "", ""))[0].iter("li"))


def test_what_has_no_points_is_no_chart() -> None:
    assert lines("A", [], "", "") == lines("A", [Series("a", [1], [None])], "", "") == ""
    assert lines("A", [Series("a", [1.0], [-1.0])], "", "", log=True) == ""
    assert drawn(lines("A", [Series("a", [7.0], [3.0])], "", ""))[1][0], "a single point is one"


def test_bars_are_as_long_as_their_share() -> None:
    text = bars([("a", 4.0, "4 s"), (EVIL, 1.0, EVIL), ("none", 0.0, "0 s")])
    assert re.findall(r"width:([\d.]+)%", text) == ["100.00", "25.00", "0.00"]
    assert "<script>" not in text and ET.fromstring(text) is not None and bars([]) == ""


@settings(deadline=None)
@given(st.lists(st.one_of(st.none(), st.floats(-1e9, 1e9)), max_size=200), st.integers(1, 40))
def test_sparks_fit_and_end_where_the_values_do(values: list[float | None], width: int) -> None:
    known = [value for value in values if value is not None]
    shown = spark(values, width)
    assert len(shown) == min(width, len(known)) and set(shown) <= set("▁▂▃▄▅▆▇█")


def test_sparks_rise_with_their_values() -> None:
    assert spark([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]) == "▁▂▃▄▅▆▇█"
    assert spark([3.0, 3.0]) == "▁▁" and spark([]) == "" and spark([0.0, 0.0, 4.0, 4.0], 2) == "▁█"
