"""What a command may replace."""

import os
from pathlib import Path

import pytest

from fprf.errors import UsageError
from fprf.io.atomic import write_text
from fprf.io.overwriting import RECORD, Origin, unused_name


def made(
    path: Path, text: str, *reads: Path, by: str = "verb", overwrite: bool = False, style: str = ""
) -> None:
    with Origin(by=by, reads=reads, overwrite=overwrite).writing([path], style):
        write_text(path, text)


@pytest.mark.parametrize("link", ["path", "symbolic", "hard", "dots"])
def test_what_is_read_is_not_overwritten_under_any_name(tmp_path: Path, link: str) -> None:
    source = tmp_path / "in" / "yard.ply"
    source.parent.mkdir()
    source.write_text("yard")
    out = tmp_path / "out.ply"
    if link == "symbolic":
        out.symlink_to(source)
    elif link == "hard":
        os.link(source, out)
    else:
        out = source if link == "path" else source.parent / ".." / "in" / "yard.ply"
    with pytest.raises(UsageError, match="overwrite"):
        made(out, "new", source)
    assert source.read_text() == out.read_text() == "yard" and not (tmp_path / RECORD).exists()
    made(out, "new", source, overwrite=True)
    assert out.read_text() == "new" and out.is_symlink() == (link == "symbolic")
    with pytest.raises(UsageError):  # also where it was made of itself before
        made(out, "newer", source if link != "hard" else out)


def test_an_output_is_replaced_by_its_own_command_alone(tmp_path: Path) -> None:
    first, second = tmp_path / "a.jpg", tmp_path / "b.jpg"
    out = tmp_path / "new" / "x.ply"
    made(out, "one", first)
    made(out, "two", first)
    assert out.read_text() == "two"
    for reads, by in ((second, "verb"), (first, "other")):
        with pytest.raises(UsageError):
            made(out, "three", reads, by=by)
    assert out.read_text() == "two"
    made(out, "three", second, overwrite=True)
    made(out, "four", second)
    out.write_text("by hand")
    with pytest.raises(UsageError):
        made(out, "five", second)
    assert out.read_text() == "by hand"


def test_what_a_killed_command_left_is_its_own(tmp_path: Path) -> None:
    out = tmp_path / "x.png"
    origin = Origin(by="verb", reads=(tmp_path / "a.jpg",))
    with origin.writing([out]):
        out.write_text("half")
        with origin.writing([out]):  # announced, not yet listed
            out.write_text("whole")
    assert out.read_text() == "whole"


def test_a_moved_project_keeps_its_outputs(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.mkdir()
    made(old / "out" / "x.ply", "one", old / "a.jpg")
    new = old.rename(tmp_path / "new")
    made(new / "out" / "x.ply", "two", new / "a.jpg")
    assert (new / "out" / "x.ply").read_text() == "two"


def test_a_failure_leaves_no_folders_and_no_list(tmp_path: Path) -> None:
    with pytest.raises(ValueError), Origin(by="verb").writing([tmp_path / "a" / "b" / "x.png"]):
        raise ValueError
    assert not list(tmp_path.iterdir())


def test_a_folder_holds_one_style(tmp_path: Path) -> None:
    made(tmp_path / "0001.png", "one", style="dusk")
    made(tmp_path / "0002.png", "one", style="dusk")
    (tmp_path / "mine.png").write_text("mine")
    made(tmp_path / "0003.png", "two", style="snow")
    assert {path.name for path in tmp_path.glob("*.png")} == {"0003.png", "mine.png"}


def test_a_link_stays_and_its_target_is_written(tmp_path: Path) -> None:
    target = tmp_path / "there" / "real.txt"
    target.parent.mkdir()
    link = tmp_path / "link.txt"
    link.symlink_to(Path("there") / "real.txt")
    for text in ("one", "two"):
        write_text(link, text)
        assert link.is_symlink() and target.read_text() == text
    assert [path.name for path in target.parent.iterdir()] == ["real.txt"]


def test_names_that_differ_in_case_are_one() -> None:
    assert [unused_name("Sun", taken) for taken in ([], ["sun"], ["SUN", "sun-2"])] == [
        "Sun",
        "Sun-2",
        "Sun-3",
    ]
