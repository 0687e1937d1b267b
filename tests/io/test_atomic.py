import errno
import json
import math
import os
import stat
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError, NumericsError
from fprf.io.atomic import atomic_path, remove_unfinished, write_bytes, write_json, write_text

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)


def test_the_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    final = tmp_path / "a" / "b" / "film.mp4"
    with atomic_path(final) as temporary:
        assert temporary.parent == final.parent and temporary.suffix == ".mp4"
        temporary.write_bytes(b"new")
        assert not final.exists()
    assert final.read_bytes() == b"new" and list(final.parent.iterdir()) == [final]


@pytest.mark.parametrize("failure", [ValueError("x"), KeyboardInterrupt(), SystemExit(3)])
def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path, failure: BaseException) -> None:
    final = tmp_path / "m.json"
    final.write_text("old")
    with pytest.raises(type(failure)), atomic_path(final) as temporary:
        temporary.write_text("half")
        raise failure
    assert final.read_text() == "old"
    assert list(tmp_path.iterdir()) == [final]


def test_whatever_the_system_refuses_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    final = tmp_path / "m.json"
    final.write_text("old")

    def refuse(*_: object) -> None:
        raise OSError(errno.EINVAL, "Invalid argument")

    for name in ("fsync", "replace", "open"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, refuse)
            with pytest.raises(DataError, match=r"m\.json: cannot be written \(Invalid argument"):
                write_text(final, "new")
        assert final.read_text() == "old" and list(tmp_path.iterdir()) == [final]
    with pytest.raises(DataError, match=r"cannot be written \(File name too long"):
        write_text(tmp_path / ("x" * 300), "new")
    for named in (True, False):  # PyAV names no file
        with pytest.raises(DataError, match=r"cannot be written"), atomic_path(final) as temporary:
            raise FileNotFoundError(
                errno.ENOENT, "No such file or directory", str(temporary) if named else None
            )
    (tmp_path / ".m.0badf00d.json").touch()
    monkeypatch.setattr(os, "unlink", refuse)
    with pytest.raises(DataError, match=r"cannot be written \(Invalid argument"):
        remove_unfinished(tmp_path)
    with pytest.raises(ValueError, match="x"), atomic_path(final):
        raise ValueError("x")


@pytest.mark.parametrize(
    "failure", [FileNotFoundError(errno.ENOENT, "", "photo.jpg"), BrokenPipeError(errno.EPIPE, "")]
)
def test_what_the_block_meets_elsewhere_is_passed_on(tmp_path: Path, failure: OSError) -> None:
    with pytest.raises(type(failure)), atomic_path(tmp_path / "film.mp4"):
        raise failure
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_flushed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fsync = os.fsync

    def refuse(handle: int, number: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", lambda handle: refuse(handle, errno.EACCES))
    write_text(tmp_path / "x", "new")
    monkeypatch.setattr(os, "fsync", lambda handle: refuse(handle, errno.EIO))
    with pytest.raises(DataError, match=r"x: cannot be written \(Input/output error"):
        write_text(tmp_path / "x", "newer")


def test_unfinished_files_and_no_others_are_removed(tmp_path: Path) -> None:
    folder = tmp_path / "folder.0badf00d"
    for name in (".model.0123abcd.safetensors", ".tmpA1b2C3", ".events.89abcdef"):
        (tmp_path / name).touch()
    kept = {
        ".lock",
        ".hidden",
        "model.safetensors",
        ".tmp",
        ".model.safetensors",
        "model.0123abcd.json",
        folder.name,
    }
    for name in kept - {folder.name}:
        (tmp_path / name).touch()
    folder.mkdir()
    remove_unfinished(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == kept
    remove_unfinished(tmp_path / "absent")


def test_data_is_on_disk_before_the_name_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    fsync = os.fsync
    replace = os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (calls.append("fsync"), fsync(handle))[1])
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append("replace"), replace(a, b))[1])
    write_bytes(tmp_path / "x", b"1")
    assert calls == ["fsync", "replace", "fsync"]


def test_what_is_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="is a file, not a folder"):
        write_text(tmp_path / "file" / "deep" / "x", "")
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match="a folder is in the place"):
        write_text(tmp_path / "folder", "")


@settings(max_examples=25, deadline=None)
@given(json_values)
def test_json_round_trips(tmp_path_factory: pytest.TempPathFactory, value: object) -> None:
    path = tmp_path_factory.getbasetemp() / "round.json"
    write_json(path, value)
    assert json.loads(path.read_text(encoding="utf-8")) == value


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_json_refuses_what_json_lacks(tmp_path: Path, value: float) -> None:
    with pytest.raises(NumericsError, match="must be finite"):
        write_json(tmp_path / "m.json", {"psnr": [value]})
    assert not list(tmp_path.iterdir())


def test_names_from_a_locale_without_utf8_are_written_as_the_bytes_that_they_are(tmp_path: Path) -> None:
    escaped = "ünïcode 場面".encode().decode("ascii", errors="surrogateescape")
    write_json(tmp_path / "x.json", {"data": escaped})
    assert json.loads((tmp_path / "x.json").read_text(encoding="utf-8")) == {"data": "ünïcode 場面"}
