import math
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.io.report import Series, axis_ticks, figures, line_chart, number, write_scalars
from fprf.training.run import History


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


def test_what_has_no_points_is_no_chart() -> None:
    assert line_chart("A", [], "", "") == line_chart("A", [Series("a", [1], [None])], "", "") == ""
    assert line_chart("A", [Series("a", [1.0], [-1.0])], "", "", log=True) == ""
    assert drawn(line_chart("A", [Series("a", [7.0], [3.0])], "", ""))[1][0], "a single point is one"


HISTORY = History("", [10, 20], [1.5, 3.0], {"psnr": [12.0, None], "colour": [0.5, 0.25]}, {}, [])


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


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"), ("504 × 378", "504 × 378"), (True, "yes"), (0, "0"), (0.0, "0"), (34, "34"), (412345, "412,345"),
        (27.3128, "27.31"), (0.84123, "0.841"), (-0.5, "-0.500"), (93.24, "93.2"), (2101.3, "2,101"), (2.1e-5, "2.1e-05"),
    ],
)  # fmt: skip
def test_numbers_as_people_read_them(value: float | int | str | None, shown: str) -> None:
    assert number(value) == shown


def test_keys_become_labels_with_units() -> None:
    rows = list(
        figures({"psnr": 27.31, "seconds": 4, "peak_rss_mib": 2048, "feature_bytes": 12, "train_seconds": 1.5, "x": "y"})
    )
    assert [row.group for row in rows] == [""] * 6
    assert [(row.label, row.unit) for row in rows] == [
        ("PSNR", "dB"), ("Time", "s"), ("Peak memory", "MiB"), ("Feature", "B"), ("Train", "s"), ("X", ""),
    ]  # fmt: skip
