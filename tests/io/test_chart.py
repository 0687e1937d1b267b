import math
import re
import sys
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import UsageError
from fprf.io.report import Series, axis_ticks, bar_chart, line_chart, sparkline, write_scalars
from fprf.training.run import History

EVIL = """<script>"'&"""


@settings(deadline=None)
@given(st.floats(-1e3, 1e3), st.floats(1e-2, 1e6), st.integers(2, 9))
def test_ticks_are_round_even_and_inside(low: float, span: float, most: int) -> None:
    found = axis_ticks(low, low + span, most)
    assert 1 <= len(found) <= most + 1 or not found
    slack = 1e-6 * (abs(low) + span)
    assert all(low - slack <= value <= low + span + slack for value in found)
    steps = {round((b - a) / 10 ** math.floor(math.log10(b - a) + 1e-6)) for a, b in pairwise(found)}
    assert steps <= {1, 2, 5, 10} and len(steps) <= 1


def drawn(text: str) -> tuple[ET.Element, list[list[tuple[float, float]]]]:
    whole = ET.fromstring(text)
    lines = [
        [(float(x), float(y)) for x, y in (pair.split(",") for pair in line.attrib["points"].split())]
        for line in whole.iter("polyline")
    ]
    return whole, lines


def test_points_lie_where_their_numbers_say() -> None:
    text = line_chart("A", [Series("a", [0, 5, 10], [0.0, 10.0, 5.0])], "step", "dB")
    whole, ((first, top, last),) = drawn(text)
    assert first[0] < top[0] < last[0] and top[0] - first[0] == pytest.approx(last[0] - top[0], abs=0.11)
    assert first[1] > last[1] > top[1], "up is more"
    assert first[1] - last[1] == pytest.approx(last[1] - top[1], abs=0.11)
    _, _, width, height = map(float, whole.find("svg").attrib["viewBox"].split())  # type: ignore[union-attr]
    assert all(0 <= x <= width and 0 <= y <= height for x, y in (first, top, last))
    assert [label.text for label in whole.iter("text")][-1] == "step" and "A, dB" in text


def test_logarithms_space_by_factors_and_leave_out_nothing_else() -> None:
    _, (points,) = drawn(line_chart("A", [Series("a", [0, 1, 2, 3, 4], [1.0, 0.1, 0.0, None, 0.01])], "step", "", log=True))
    assert len(points) == 3
    assert points[1][1] - points[0][1] == pytest.approx(points[2][1] - points[1][1], abs=0.11)


def test_several_lines_have_a_legend_and_one_has_none() -> None:
    one, two = Series("a", [0, 1], [1.0, 2.0]), Series(EVIL, [0, 1], [2.0, 2.0])
    whole, found = drawn(line_chart(EVIL, [one, two], EVIL, EVIL))
    assert len(found) == 2 and len(list(whole.iter("li"))) == 2
    assert len({line.attrib["stroke"] for line in whole.iter("polyline")}) == 2
    assert not list(drawn(line_chart("A", [one], "", ""))[0].iter("li"))


def test_what_has_no_points_is_no_chart() -> None:
    assert line_chart("A", [], "", "") == line_chart("A", [Series("a", [1], [None])], "", "") == ""
    assert line_chart("A", [Series("a", [1.0], [-1.0])], "", "", log=True) == ""
    assert drawn(line_chart("A", [Series("a", [7.0], [3.0])], "", ""))[1][0], "a single point is one"


def test_bars_are_as_long_as_their_share() -> None:
    text = bar_chart([("a", 4.0, "4 s"), (EVIL, 1.0, EVIL), ("none", 0.0, "0 s")])
    assert re.findall(r"width:([\d.]+)%", text) == ["100.00", "25.00", "0.00"]
    assert "<script>" not in text and ET.fromstring(text) is not None and bar_chart([]) == ""


def test_sparks_rise_with_their_values() -> None:
    assert sparkline([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]) == "▁▂▃▄▅▆▇█"
    assert sparkline([3.0, 3.0]) == "▁▁" and sparkline([]) == "" and sparkline([0.0, 0.0, 4.0, 4.0], 2) == "▁█"


HISTORY = History("", [10, 20], [1.5, 3.0], {"psnr": [12.0, None], "colour": [0.5, 0.25]}, {}, [])


def test_without_the_package_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.writer", None)
    with pytest.raises(UsageError, match=r"--tensorboard: .* pip install 'fprf\[tensorboard\]'"):
        write_scalars(tmp_path, [HISTORY])
    assert list(tmp_path.iterdir()) == []


def read(folder: Path) -> dict[str, list[tuple[int, float, float]]]:
    reader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = reader.EventAccumulator(str(folder))
    events.Reload()
    return {tag: [(e.step, e.wall_time, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="the extra `tensorboard` is not installed")
    block = HISTORY._replace(name="02")
    for _ in range(2):  # again, in place of the first
        assert write_scalars(tmp_path, [HISTORY, block]) == 6
    assert {path.name for path in tmp_path.iterdir()} == {"training", "02"}
    found = read(tmp_path / "training")
    assert found == {"psnr": [(10, 1.5, 12.0)], "colour": [(10, 1.5, 0.5), (20, 3.0, 0.25)]} == read(tmp_path / "02")
