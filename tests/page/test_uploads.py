import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from photo_files import HEIC, turned_jpeg
from raw_files import dng

from fprf.errors import DataError, UsageError
from fprf.io.images import encode
from fprf.page import uploads
from fprf.page.uploads import (
    MAX_BYTES,
    MAX_SIDE,
    SceneFiles,
    Uploads,
    check_photograph,
    find_source,
    shown_name,
)


def png(width: int, height: int) -> bytes:
    drawn = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return bytes(cv2.imencode(".png", drawn)[1].tobytes())


def claimed(width: int, height: int) -> bytes:
    """The head of a PNG that says it is so large, and ends."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


@pytest.fixture(scope="module")
def uploaded() -> Iterator[Uploads]:
    with closing(Uploads(timeout=120)) as found:
        yield found


def test_a_photograph_becomes_a_png_of_ours(uploaded: Uploads) -> None:
    path = uploaded.store(png(60, 40))
    assert path.parent == uploaded.folder and path.suffix == ".png"
    assert cv2.imread(str(path)).shape == (40, 60, 3)
    large = uploaded.store(png(MAX_SIDE * 2, 100))
    assert cv2.imread(str(large)).shape == (50, MAX_SIDE, 3)
    assert sorted(uploaded.folder.glob("*.part")) == []


def test_photographs_of_phones_come_upright(uploaded: Uploads, tmp_path: Path) -> None:
    shown = turned_jpeg(
        tmp_path / "a.jpg", cv2.imdecode(np.frombuffer(png(60, 40), np.uint8), cv2.IMREAD_COLOR), 6
    )
    assert np.array_equal(
        cv2.imread(str(uploaded.store((tmp_path / "a.jpg").read_bytes())))[:, :, ::-1], shown
    )
    pytest.importorskip("pillow_heif")
    assert cv2.imread(str(uploaded.store(HEIC))).shape == (64, 48, 3)


def test_what_is_transparent_stays_so(uploaded: Uploads) -> None:
    layers = np.zeros((80, 120, 4), np.uint8)
    layers[:] = (255, 255, 255, 0)
    layers[20:60, 30:90] = (40, 90, 200, 255)
    found = cv2.imread(str(uploaded.store(encode(layers, "png"))), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(found[:, :, 3], layers[:, :, 3])
    assert (found[found[:, :, 3] == 255] == (200, 90, 40, 255)).all()
    large = np.kron(layers, np.ones((20, 20, 1), np.uint8))
    small = cv2.imread(str(uploaded.store(encode(large, "png"))), cv2.IMREAD_UNCHANGED)
    assert max(small.shape) == MAX_SIDE
    assert (small[small[:, :, 3] >= 128][:, :3] == (200, 90, 40)).all(), "no colour of what is behind"
    layers[:, :, 3] = 0
    with pytest.raises(DataError, match=r"photograph: 0\.00% of its pixels are opaque"):
        uploaded.store(encode(layers, "png"))


def test_raw_photographs_are_developed(uploaded: Uploads) -> None:
    pytest.importorskip("rawpy")
    flat = np.full((64, 96, 3), (0.8, 0.4, 0.2))
    found = cv2.imread(str(uploaded.store(dng(flat, np.zeros((6, 9, 3), np.uint8)))))
    assert found.shape == (64, 96, 3)
    assert np.abs(found[:, :, ::-1] / 255 - flat).max() < 0.01


def test_a_photograph_is_refused_by_its_first_bytes_before_anything_is_decoded(uploaded: Uploads) -> None:
    with pytest.raises(DataError, match="100000x100000 pixels"):
        uploaded.store(claimed(100_000, 100_000) + png(2, 2)[33:])
    for data, said in (
        (b"", "no PNG"),
        (b"GIF89a" + b"x" * 100, "no PNG"),
        (b"\x89PNG\r\n\x1a\n" + b"x" * (MAX_BYTES + 1), f"at most {MAX_BYTES}"),
    ):
        with pytest.raises(DataError, match=said):
            check_photograph(data)


@pytest.mark.parametrize(
    "data",
    [
        claimed(30, 20),
        claimed(0, 10),
        png(30, 20)[:-40],
        b"\xff\xd8\xff" + b"\xc0\0\x0b\x08\0\x10\0\x10" + b"\0" * 40,
    ],
)
def test_damaged_ones_are_told_and_the_next_one_goes(uploaded: Uploads, data: bytes) -> None:
    with pytest.raises(DataError, match="photograph: ") as told:
        uploaded.store(data)
    assert str(uploaded.folder) not in str(told.value)
    assert uploaded.store(png(20, 20)).is_file()


def test_a_decoder_that_died_is_replaced(uploaded: Uploads) -> None:
    uploaded.store(png(20, 20))
    process = uploaded._process
    process.kill()
    process.join()
    assert uploaded.store(png(20, 20)).is_file() and uploaded._process is not process


def working(pipe: Connection) -> None:
    """A decoder that comes to no end."""
    pipe.recv_bytes()
    while True:
        pass


def sleeping(pipe: Connection) -> None:
    """A decoder that waits for ever."""
    pipe.recv_bytes()
    time.sleep(3600)


def held_up(pipe: Connection) -> None:
    """A decoder that has the processor for a moment now and then."""
    while True:
        pipe.recv_bytes()
        time.sleep(1.5)
        pipe.send_bytes(b"")


@pytest.mark.parametrize(
    ("decoder", "said"), [(working, "not decoded within 0.5 s"), (sleeping, "stood still")]
)
def test_a_decoder_that_comes_to_no_end_is_ended(
    decoder: Callable[[Connection], None], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uploads, "decode_photographs", decoder)
    limit = 0.5
    if decoder is sleeping:
        limit = 1e6
        monkeypatch.setattr(uploads, "_MAX_IDLE_SECONDS", 1.0)
    with closing(Uploads(timeout=limit)) as found, pytest.raises(DataError, match=said):
        found.store(png(20, 20))
    assert not found.folder.exists()


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="this system does not tell")
def test_a_decoder_may_take_its_time_on_a_loaded_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "decode_photographs", held_up)
    with closing(Uploads(timeout=1e6)) as found:
        found.store(png(20, 20))  # its start counts, too
        found._timeout = 0.5
        found.store(png(20, 20))


@pytest.mark.skipif(os.name != "posix", reason="limits are a matter of Unix")
def test_memory_beyond_the_room_is_refused() -> None:
    greedy = "import numpy; from fprf.page import uploads; uploads.limit_memory(64 << 20); numpy.ones(256 << 20, numpy.uint8)"
    ended = subprocess.run([sys.executable, "-c", greedy], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 1 and "MemoryError" in ended.stderr


def test_names_are_shown_plain_and_short() -> None:
    for name, shown in {
        "../../etc/passwd": "passwd",
        "C:\\photos\\a b.png": "a b.png",
        "<script>alert(1)</script>.png": "script_.png",
        "": "photograph",
        "line\nbreak\x00.png": "linebreak.png",
        "Übung-ñ.jpeg": "Übung-ñ.jpeg",
    }.items():
        assert shown_name(name) == shown
    found = shown_name("x" * 300 + ".jpg")
    assert len(found) <= 48 and found.endswith(".jpg") and "…" in found


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


@given(
    more=st.binary(max_size=200),
    piece=st.integers(60, 300),
    name=st.sampled_from(["a.png", "images/01 é.png"]),
)
def test_a_file_in_pieces_is_the_file(
    tmp_path_factory: pytest.TempPathFactory, more: bytes, piece: int, name: str
) -> None:
    folder = tmp_path_factory.mktemp("x") / "files"
    data = PICTURE + more
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
