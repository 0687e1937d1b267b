"""What a scene folder's files may say, and what they may not; poses made exact, sizes and numbers checked."""

import io
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from capture_files import rotations
from hypothesis import given
from hypothesis import strategies as st

from fprf.datamanagers.parsers.files import as_record, path_inside, read_json, read_npy, read_npz
from fprf.datamanagers.parsers.views import rigid_pose
from fprf.errors import DataError


def test_loose_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text in (
        b'{"a": Nan(', b'{"a": infinite}', b'{"a": 1e400}', b'{"a": 1, "a": 2}', b"[" * 100_000,
        b'{"a": ' + b"9" * 5000 + b"}", b"\xff\xfe", b"", b"{", b"{} {}",
    ):  # fmt: skip
        path.write_bytes(text)
        with pytest.raises(DataError, match=r"a\.json: no valid JSON") as caught:
            read_json(path)
        assert len(str(caught.value)) < 500


def test_paths_stay_inside_and_are_normalised() -> None:
    for text in (
        "/etc/passwd", "../a.png", "images/../../a.png", "..", "a\\..\\..\\b", "C:\\a.png", "/roots/a.png",
        "\\\\host\\share\\a.png", "", ".", "images/..", "a\0b", "a\nb", "a\x1b[2Jb", "\ud800", "\u2028",
    ):  # fmt: skip
        with pytest.raises(DataError, match="here: the path"):
            path_inside(Path("root"), "here", text)
    for text in ("images/a b.png", "./images/a b.png", "images//a b.png", ".\\images\\a b.png", "x/../images/a b.png"):
        assert path_inside(Path("root"), "here", text) == ("images/a b.png", Path("root/images/a b.png"))


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["<f8", "<f4", ">f8", "<i4", "|u1"])
@pytest.mark.parametrize("shape", [(), (3,), (2, 5), (0, 17)])
def test_arrays_come_back(kind: str, shape: tuple[int, ...]) -> None:
    array = np.arange(int(np.prod(shape)), dtype=kind).reshape(shape)
    read = read_npy("here", npy(array))
    assert read.dtype == np.float64 and read.shape == shape and np.array_equal(read, array)


@pytest.mark.parametrize("field", [20, 24])
def test_an_archive_that_claims_more_than_the_file_holds_takes_no_memory(tmp_path: Path, field: int) -> None:
    """Packed and unpacked size stand in the directory at its end; a gigabyte is allowed for an array."""
    path = tmp_path / "a.npz"
    np.savez(path, xyz=np.arange(9.0))
    data = path.read_bytes()
    head = data.rfind(b"PK\x01\x02")
    path.write_bytes(data[: head + field] + struct.pack("<I", 1 << 30) + data[head + field + 4 :])
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match=r"claims .* bytes, but the file has 3"):
            read_npz(path, "xyz")
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_records_fall_back_and_name_the_place() -> None:
    top = as_record("f.json", {"w": 5, "frames": [{"a": 1.5}, {"w": 7, "b": "x"}]})
    first, second = top.records("frames")
    assert (first.number("w"), second.number("w"), first.number("a"), second.number("a")) == (5.0, 7.0, 1.5, None)
    assert second.text("b") == "x"
    for wrong in ({"a": "x"}, {"a": True}, {"a": 10**400}, {"a": [1]}):
        with pytest.raises(DataError, match=r"^here: a is "):
            as_record("here", wrong).number("a")
    for call, value in (("text", 3), ("texts", "x"), ("texts", [1]), ("matrix", [[1, 2, 3, 4]]), ("matrix", "abc")):
        with pytest.raises(DataError, match=r"^here: a "):
            getattr(as_record("here", {"a": value}), call)("a")
    with pytest.raises(DataError, match=r"frames\[1\]: 3 instead of an object"):
        as_record("f", {"frames": [{}, 3]}).records("frames")
    for empty in ({}, {"frames": []}, {"frames": 3}):
        with pytest.raises(DataError, match="no list of frames"):
            as_record("f", empty).records("frames")


@given(st.integers(0, 999), st.floats(0, 4e-4))
def test_rounded_rotations_are_repaired(seed: int, amount: float) -> None:
    draw = np.random.default_rng(seed)
    exact = np.concatenate([rotations(draw.normal(size=(1, 3)))[0], draw.normal(size=(3, 1))], 1)
    noisy = exact.copy()
    noisy[:, :3] += amount * draw.uniform(-0.5, 0.5, (3, 3))
    repaired = rigid_pose("here", noisy)
    assert np.abs(repaired[:, :3].T @ repaired[:, :3] - np.eye(3)).max() < 1e-14
    assert np.abs(repaired - exact).max() <= 2 * amount + 1e-14
    assert np.array_equal(repaired[:, 3], exact[:, 3])
