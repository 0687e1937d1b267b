"""What is exported, to which files, in which styles."""

from pathlib import Path

import pytest

from fprf.errors import UsageError
from fprf.export.config import KINDS, named_styles, plan
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile


def test_a_folder_takes_all_kinds_or_those_that_are_named(tmp_path: Path) -> None:
    assert plan([], tmp_path) == (tuple(KINDS), tmp_path, None)
    assert plan(["splat", "ply", "splat"], Path("out")) == (("splat", "ply"), Path("out"), None)
    assert plan(["splats", "mesh", "points", "glb"], Path("out")).kinds == ("splat", "glb", "ply")


@pytest.mark.parametrize(
    ("kinds", "name", "kind"),
    [([], "a.ply", "ply"), (["splat"], "a.ply", "splat"), ([], "a.SPLAT", "splat"), ([], "t.json", "cameras")],
)
def test_a_file_holds_what_its_ending_says(kinds: list[str], name: str, kind: str) -> None:
    assert plan(kinds, Path("to") / name) == ((kind,), Path("to"), Path("to") / name)


@pytest.mark.parametrize(("kinds", "output"), [(["spalt"], "out"), (["cameras"], "a.ply"), (["ply", "splat"], "a.ply")])
def test_what_does_not_fit_is_refused(kinds: list[str], output: str) -> None:
    with pytest.raises(UsageError):
        plan(kinds, Path(output))


@pytest.mark.parametrize("text", ["dusk", "=a.jpg", "dusk=", "du sk=a.jpg", "../x=a.jpg"])
def test_other_forms_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        named_styles([text], StyleFile(StyleConfig()))
