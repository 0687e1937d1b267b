"""What a scene folder's files may say, and what they may not."""

import io
import json
import os
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from capture_files import write_image
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fprf.datamanagers.parsers.files import image_names, inside, read_bytes, read_json, read_npy, read_npz, record_of
from fprf.datamanagers.parsers.views import every_eighth, indices
from fprf.errors import DataError

FUZZ = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.mark.parametrize(
    "text",
    [
        b'{"a": NaN}',
        b'{"a": -Infinity}',
        b'{"a": 1e400}',
        b'{"a": 1, "a": 2}',
        b"[" * 100_000,
        b'{"a": ' + b"9" * 5000 + b"}",
        b"\xff\xfe",
        b"",
        b"{",
        b"{} {}",
    ],
)
def test_loose_json_is_refused(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text)
    with pytest.raises(DataError, match=r"a\.json: no valid JSON") as caught:
        read_json(path)
    assert len(str(caught.value)) < 500


def test_plain_json_is_read_with_and_without_a_mark(tmp_path: Path) -> None:
    value = {"a": [1, -2.5e3, True, None, "é"], "b": {"a": 1}}
    for mark in (b"", b"\xef\xbb\xbf"):
        (tmp_path / "a.json").write_bytes(mark + json.dumps(value).encode())
        assert read_json(tmp_path / "a.json") == value


@pytest.mark.parametrize(
    "text",
    [
        "/etc/passwd",
        "../a.png",
        "images/../../a.png",
        "..",
        "a\\..\\..\\b",
        "C:\\a.png",
        "C:a.png",
        "\\\\host\\share\\a.png",
        "",
        ".",
        "a\0b",
        "\ud800",
        "images/../a.png",
    ],
)
def test_paths_that_leave_the_root_are_refused(text: str) -> None:
    with pytest.raises(DataError, match="here: the path"):
        inside(Path("root"), "here", text)


def test_paths_inside_are_normalised() -> None:
    for text in ("images/a b.png", "./images/a b.png", "images//a b.png", ".\\images\\a b.png"):
        assert inside(Path("root"), "here", text) == ("images/a b.png", Path("root/images/a b.png"))


def test_an_absurdly_long_path_is_no_crash(tmp_path: Path) -> None:
    _, path = inside(tmp_path, "here", "a" * 10_000)
    with pytest.raises(DataError, match="cannot be read"):
        read_bytes(path)


def test_folders_are_listed_by_name(tmp_path: Path) -> None:
    for name in ("b.PNG", "a.jpg", "notes.txt", ".hidden.png"):
        (tmp_path / name).touch()
    assert image_names(tmp_path) == ["a.jpg", "b.PNG"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no image among 0 files"):
        image_names(tmp_path / "empty")
    with pytest.raises(DataError, match="no such image folder"):
        image_names(tmp_path / "absent")


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


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x93NUMPY",
        npy(np.zeros(3))[:-1],
        npy(np.zeros(3)) + b"x",
        npy(np.asfortranarray(np.zeros((2, 3)))),
        npy(np.array(["a"])),
        npy(np.zeros(8, np.uint8)).replace(b"|u1", b"|f1"),  # there are no floats of one byte
        npy(np.zeros(3)).replace(b"(3,)", b"(9999999999999999,)"),
        b"\x93NUMPY\x01\x00"
        + struct.pack("<H", 70)
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': ("
        + b"9" * 60
        + b",)}",
    ],
)
def test_odd_arrays_are_refused(data: bytes) -> None:
    with pytest.raises(DataError, match=r"^here: "):
        read_npy("here", data)


def test_pickles_are_never_opened(tmp_path: Path) -> None:
    canary = tmp_path / "canary"

    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[object, ...]]:
            return os.mkdir, (str(canary),)

    np.save(tmp_path / "a.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    with pytest.raises(DataError):
        read_npy("a", (tmp_path / "a.npy").read_bytes())
    np.savez(tmp_path / "a.npz", xyz=np.array([Bomb()], dtype=object))
    with pytest.raises(DataError):
        read_npz(tmp_path / "a.npz", "xyz")
    assert not canary.exists()


@FUZZ
@given(st.integers(0, 200), st.lists(st.tuples(st.integers(0, 130), st.integers(0, 255)), max_size=3))
def test_any_bytes_are_an_array_or_a_data_error(stop: int, changes: list[tuple[int, int]]) -> None:
    data = bytearray(npy(np.arange(4.0)))
    for place, value in changes:
        data[place] = value
    try:
        read_npy("here", bytes(data[:stop]))
    except DataError:
        return


@FUZZ
@given(st.data())
def test_any_archive_is_points_or_a_data_error(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, xyz=np.arange(12.0).reshape(4, 3))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        read_npz(path, "xyz")
    except DataError:
        return


def test_an_archive_without_the_array_says_so(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", other=np.zeros(3))
    with pytest.raises(DataError, match="no array 'xyz'"):
        read_npz(tmp_path / "a.npz", "xyz")


def test_an_archive_that_claims_too_much_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xyz.npy", b"1234")
    data = path.read_bytes()
    head = data.rfind(b"PK\x01\x02")
    path.write_bytes(data[: head + 24] + struct.pack("<I", 0xFFFFFFF0) + data[head + 28 :])
    with pytest.raises(DataError):
        read_npz(path, "xyz")


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


def test_what_deflates_well_is_read(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", xyz=np.zeros((300_000, 3)))
    assert read_npz(tmp_path / "a.npz", "xyz").shape == (300_000, 3)


def test_records_fall_back_and_name_the_place() -> None:
    top = record_of("f.json", {"w": 5, "frames": [{"a": 1.5}, {"w": 7, "b": "x"}]})
    first, second = top.records("frames")
    assert (first.number("w"), second.number("w"), first.number("a"), second.number("a")) == (5.0, 7.0, 1.5, None)
    assert second.text("b") == "x"
    for wrong in ({"a": "x"}, {"a": True}, {"a": 10**400}, {"a": [1]}):
        with pytest.raises(DataError, match=r"^here: a is "):
            record_of("here", wrong).number("a")
    for call, value in (("text", 3), ("texts", "x"), ("texts", [1]), ("matrix", [[1, 2, 3, 4]]), ("matrix", "abc")):
        with pytest.raises(DataError, match=r"^here: a "):
            getattr(record_of("here", {"a": value}), call)("a")
    with pytest.raises(DataError, match=r"frames\[1\]: 3 instead of an object"):
        record_of("f", {"frames": [{}, 3]}).records("frames")
    for empty in ({}, {"frames": []}, {"frames": 3}):
        with pytest.raises(DataError, match="no list of frames"):
            record_of("f", empty).records("frames")


@settings(max_examples=60, deadline=None)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
        max_leaves=20,
    )
)
def test_any_json_value_is_read_or_refused(value: object) -> None:
    for call in ("number", "text", "texts", "matrix", "records"):
        try:
            getattr(record_of("here", value), call)("a")  # type: ignore[arg-type]
        except DataError:
            continue


def test_the_split_is_llff_s() -> None:
    train, test = every_eighth(20)
    assert test.tolist() == [0, 8, 16] and sorted(train.tolist() + test.tolist()) == list(range(20))
    assert [part.tolist() for part in every_eighth(1)] == [[0], []]
    assert [part.tolist() for part in every_eighth(2)] == [[1], [0]]
    assert indices([True, False, True]).tolist() == [0, 2]


def test_hidden_files_of_a_mac_are_no_images(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", (4, 4))
    (tmp_path / "._a.png").write_bytes(b"resource fork")
    assert image_names(tmp_path) == ["a.png"]


@pytest.mark.parametrize(("shape", "sides"), [("(03, 2)", (3, 2)), ("(6,)", (6,)), ("(2, 3, )", (2, 3)), ("(3,2)", (3, 2))])
def test_shapes_of_arrays_are_read_as_numbers_never_as_code(shape: str, sides: tuple[int, ...]) -> None:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    data = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + np.arange(6.0).tobytes()
    assert read_npy("x", data).shape == sides


@pytest.mark.parametrize("shape", ["(3)", "((3, 2))", "(3 2)", "(-3, 2)", "(3,, 2)", "3, 2", "(1e1,)"])
def test_shapes_that_are_none_are_refused(shape: str) -> None:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    data = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + np.arange(6.0).tobytes()
    with pytest.raises(DataError):
        read_npy("x", data)
