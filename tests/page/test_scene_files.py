from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import DataError, UsageError
from fprf.page.uploads import SceneFiles, find_source

PICTURE = cv2.imencode(".png", np.zeros((6, 8, 3), np.uint8))[1].tobytes()
HEADS = {
    "a.png": PICTURE,
    "a.ply": b"ply\nformat",
    "a.splat": bytes(64),
    "a.spz": b"\x1f\x8b" + bytes(30),
    "a.sog": b"PK\x03\x04",
    "a.mp4": b"\0\0\0\x20ftypisom",
    "a.webm": b"\x1aE\xdf\xa3" + bytes(8),
    "transforms.json": b' {"frames": []}',
    "lod-meta.json": b'{"lodLevels": 1}',
    "poses_bounds.npy": b"\x93NUMPY",
    "points.npz": b"PK\x03\x04",
}


@given(more=st.binary(max_size=200), piece=st.integers(60, 300), name=st.sampled_from(["a.png", "images/01 é.png"]))
def test_a_file_in_pieces_is_the_file(tmp_path_factory: pytest.TempPathFactory, more: bytes, piece: int, name: str) -> None:
    folder, data = tmp_path_factory.mktemp("x") / "files", PICTURE + more
    files = SceneFiles(folder)
    for at in range(0, len(data), piece):
        assert not (folder / name).exists()
        files.add(name, at, len(data), data[at : at + piece])
    assert (folder / name).read_bytes() == data and not list(folder.rglob("*.part"))


def test_pieces_out_of_order_and_longer_files_are_refused(tmp_path: Path) -> None:
    files = SceneFiles(tmp_path / "files")
    files.add("a.splat", 0, 64, bytes(32))
    for at, data in ((16, bytes(16)), (64, bytes(16)), (32, bytes(33)), (32, b"")):
        with pytest.raises(UsageError, match=r"a\.splat"):
            files.add("a.splat", at, 64, data)
    files.add("a.splat", 32, 64, bytes(32))
    assert (tmp_path / "files" / "a.splat").stat().st_size == 64


@pytest.mark.parametrize(
    "name",
    ["", "/etc/a.png", "../a.png", "b/../../a.png", ".hidden.png", "b/.ssh/a.png", "a\\b.png", "C:a.png", "a\0.png",
     "x" * 200 + ".png", "1/2/3/4/5/6/a.png"],
)  # fmt: skip
def test_a_name_stays_in_its_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError):
        SceneFiles(tmp_path / "files").add(name, 0, len(PICTURE), PICTURE)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize("name", HEADS)
def test_kinds_are_taken_by_their_content_and_refused_without(tmp_path: Path, name: str) -> None:
    files = SceneFiles(tmp_path / "files")
    files.add(name, 0, len(HEADS[name]), HEADS[name])
    for wrong in (f"other-{name}", f"{name}.txt", f"{name}.exe", "notes.txt"):
        with pytest.raises(DataError, match=wrong):
            files.add(wrong, 0, 33, b"nothing of that kind" + bytes(13))
    assert [path.name for path in (tmp_path / "files").iterdir()] == [name]


def test_a_full_disk_and_too_many_files_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = SceneFiles(tmp_path / "files")
    with pytest.raises(DataError, match="at most"):
        files.add("a.mp4", 0, 1 << 40, HEADS["a.mp4"])
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("Usage", (), {"free": 10}))
    with pytest.raises(DataError, match="full"):
        files.add("a.png", 0, len(PICTURE), PICTURE)


@pytest.mark.parametrize(
    ("names", "kind", "last"),
    [
        ("lod-meta.json", "capture", ""),
        ("config.json", "run", ""),
        ("x.spz", "capture", "x.spz"),
        ("meta.json", "capture", ""),
        ("walk.MOV", "video", "walk.MOV"),
        ("1.jpg 2.jpg 3.jpg", "photographs", ""),
        ("1.jpg 2.jpg 3.jpg transforms.json", "scene", ""),
        ("1.jpg 2.jpg 3.jpg points.ply", "photographs", ""),
    ],
)
def test_what_a_folder_becomes(tmp_path: Path, names: str, kind: str, last: str) -> None:
    for name in names.split():
        (tmp_path / name).touch()
    assert find_source(tmp_path) == (kind, tmp_path / last)
    assert not last or find_source(tmp_path / last) == (kind, tmp_path / last)


@pytest.mark.parametrize(
    ("names", "told"),
    [(["a.jpg"], "1 photograph is no scene"), (["a.jpg", "b.mp4"], "1 photograph"), (["a.mp4", "b.mp4"], "2 videos"),
     (["a.ply", "b.ply"], "2 captures"), (["notes.txt"], "nothing that a scene"), ([], "nothing that a scene")],
)  # fmt: skip
def test_what_no_scene_is_made_of_is_refused(tmp_path: Path, names: list[str], told: str) -> None:
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(DataError, match=told):
        find_source(tmp_path)
    with pytest.raises(DataError, match="no such"):
        find_source(tmp_path / "absent")
