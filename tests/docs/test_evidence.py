"""Figures of README and documents stand in results; results say what they were measured on, and whether that has changed."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from benchmarks import evidence, record
from benchmarks.evidence import (
    ROOT,
    Figure,
    Origin,
    Value,
    read_result,
    result_files,
    sources_hash,
    stale,
    uncited,
    unfounded,
)
from benchmarks.tables import CURVES, drawn, filled, mark
from fprf.errors import DataError, UsageError

PAGES = evidence.pages()
AGAIN = (
    "measure again (python -m benchmarks record NAME), or say what has changed "
    '(python -m benchmarks tables --before "CHANGE")'
)


@pytest.mark.parametrize("name", result_files())
def test_a_result_says_where_it_comes_from_and_is_of_this_tree_or_says_of_which(name: str) -> None:
    origin, figures = read_result(result_files()[name])
    assert re.fullmatch(r"[0-9a-f]{7,12}\+?", origin.commit) and re.fullmatch(r"\d{4}-\d\d-\d\d", origin.date)
    assert origin.command and origin.sources and figures
    absent = [source for source in origin.sources if not (ROOT / source).exists()]
    assert not absent or origin.before, "sources that are gone"
    assert not stale(origin), f"{name}: sources have changed since {origin.commit}: {AGAIN}"


def test_each_result_is_cited() -> None:
    assert uncited() == [], "no page quotes them: quote them, or delete them"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_each_figure_stands_in_a_result(page: Path) -> None:
    assert unfounded(page.read_text("utf-8")) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_tables_and_marks_are_those_of_the_results(page: Path) -> None:
    assert filled(page) == page.read_text("utf-8"), "python -m benchmarks tables"


def test_the_drawing_is_that_of_the_results() -> None:
    assert drawn() == CURVES.read_text("utf-8"), "python -m benchmarks tables"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A repository of one source, one result and one page."""
    for folder in (*evidence.FOLDERS, Path("fprf")):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "fprf" / "a.py").write_text('"""Old."""\n\nX = 1  # one\n')
    origin = Origin(
        commit="0123456",
        command="by hand",
        date="2026-01-02",
        sources=("fprf/a.py",),
        sources_hash=sources_hash(["fprf/a.py"], tmp_path),
    )
    made = evidence.document(origin, {"rows": {"psnr": 23.204, "seconds": 0.0714, "rays": 28735}})
    (tmp_path / "benchmarks/results/fox.json").write_text(json.dumps(made))
    (tmp_path / "README.md").write_text("It takes 71 ms (<!-- of: fox --><!-- end -->).\n")
    return tmp_path


@pytest.mark.parametrize(
    "text, changes",
    [
        ('"""New."""\n\n\nX = 1\n', False),
        ('"""Old."""\n\nX = 2  # one\n', True),
        ('"""Old."""\n\nX = 1  # one\nY = "text"\n', True),
    ],
)
def test_only_what_runs_makes_a_result_old(place: Path, text: str, changes: bool) -> None:
    path = place / "fprf" / "a.py"
    path.write_text(text)
    evidence._file_hash.cache_clear()
    origin, _ = read_result(place / "benchmarks/results/fox.json")
    assert stale(origin, place) == changes
    if changes:
        with pytest.raises(UsageError, match="fox: sources have changed"):
            mark("", place)
        assert mark("two", place) == ["fox"] and mark("", place) == []
        assert "fox.json`](benchmarks/results/fox.json), of 0123456, before two<!-- end -->" in filled(
            place / "README.md", place
        )
    else:
        assert mark("", place) == []


@pytest.mark.parametrize(
    "said, wrong",
    [
        ("71 ms, 23.2 dB and 28 700 rays/s (<!-- of: fox --><!-- end -->)", 0),
        ("72 ms, 23.3 dB and 28 800 rays/s (<!-- of: fox --><!-- end -->)", 3),
        ("23.2 dB", 1),
        ("23.2 dB <!-- unmeasured: as published -->", 0),
        ("at most `23.3 dB`", 0),
        ("23.20 to 23.4 dB (<!-- of: fox/rows --><!-- end -->)", 1),
        ("23.2 dB\n\n<!-- of: fox --><!-- end -->", 1),
    ],
)
def test_figures_of_a_page_are_looked_up(place: Path, said: str, wrong: int) -> None:
    assert len(unfounded(said, place)) == wrong


def test_what_is_named_must_be_there(place: Path) -> None:
    for name in ("bear", "fox/columns"):
        with pytest.raises(DataError, match=name.rpartition("/")[2]):
            unfounded(f"1 s <!-- of: {name} --><!-- end -->", place)
    assert uncited(place) == []
    (place / "README.md").write_text("Nothing.\n")
    assert uncited(place) == ["fox"]


def test_digits_that_are_printed_and_the_key_decide() -> None:
    assert Figure("0.9", "dB").equals(Value(-0.85, "psnr")) and not Figure("0.90", "dB").equals(
        Value(-0.85, "psnr")
    )
    assert Figure("1.6", "GiB").equals(Value(1638.4, "peak_rss_mib")) and Figure("16", "%").equals(
        Value(0.1616, "")
    )
    assert not Figure("0.9", "dB").equals(Value(0.9, "ssim")) and Figure("0.90", "").equals(
        Value(0.9, "ssim")
    )


def test_a_record_names_command_and_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["fresh", "--folder", str(tmp_path)]
    with pytest.raises(UsageError, match="no sources"):
        record.main(words)
    with pytest.raises(UsageError, match=r"nowhere\.py not in the repository"):
        record.main([*words, "--sources", "nowhere.py"])
    with pytest.raises(UsageError, match="no benchmark makes it alone"):
        record.main([*words, "--sources", "fprf/ops"])
    (tmp_path / "fresh.json").write_text('{"commit": "old", "command": "old", "rows": [1]}')
    assert record.main([*words, "--sources", "fprf/ops", "--command", "by hand: a rule"]) == 0
    origin, found = read_result(tmp_path / "fresh.json")
    assert found == {"rows": [1]} and origin.command == "by hand: a rule" and origin.sources == ("fprf/ops",)
    assert not stale(origin) and stale(dataclasses.replace(origin, sources=("fprf/io",)))
