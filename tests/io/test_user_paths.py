import os
from pathlib import Path, PurePosixPath

import pytest

from fprf.errors import UsageError
from fprf.io.paths import as_path, as_paths, expanded


class Named:
    """A path-like object of another library."""

    def __fspath__(self) -> str:
        return "~/x.ply"


def test_the_home_folder_and_path_like_objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    for written in ("~/x.ply", Path("~/x.ply"), PurePosixPath("~/x.ply"), Named()):
        assert as_path(written) == tmp_path / "x.ply"
    assert as_path("a~b") == Path("a~b") and as_path("./~") == Path("~")
    assert as_paths("a.jpg") == (Path("a.jpg"),) and as_paths(["a.jpg", Named()])[1] == tmp_path / "x.ply"


def test_wildcards_are_what_they_match(tmp_path: Path) -> None:
    for name in ("b.ply", "a.ply", "c [1].ply", ".hidden.ply", "deep/d.ply"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = expanded([tmp_path / "*.ply", tmp_path / "c [1].ply", tmp_path / "**" / "d.ply"])
    assert [os.path.relpath(path, tmp_path) for path in found] == [
        "a.ply", "b.ply", "c [1].ply", "c [1].ply", str(Path("deep/d.ply")),
    ]  # fmt: skip
    with pytest.raises(UsageError, match="no file matches"):
        expanded([tmp_path / "*.spz"])
