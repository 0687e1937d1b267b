"""TFRecord files: the checksum against its published values, records and Examples, and every way of being damaged."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from record_files import example, record, varint

from fprf.datamanagers.parsers.blocknerf import crc32c, masked, read_examples, read_records
from fprf.errors import DataError


@pytest.mark.parametrize(
    "data, value",
    [
        (b"", 0),
        (b"123456789", 0xE3069283),
        (bytes(32), 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
        (bytes(range(31, -1, -1)), 0x113FDB5C),
    ],
)
def test_values_of_rfc_3720(data: bytes, value: int) -> None:
    assert crc32c(data) == value


@pytest.mark.parametrize("length", [16383, 16384, 16385, 20000, 99_991])
def test_chunks_agree_with_one_byte_after_the_other(length: int) -> None:
    data = np.random.default_rng(length).integers(0, 256, length, dtype=np.uint8).tobytes()
    state = 0xFFFFFFFF
    for byte in data:
        state ^= byte
        for _ in range(8):
            state = state >> 1 ^ (0x82F63B78 if state & 1 else 0)
    assert crc32c(data) == state ^ 0xFFFFFFFF


def test_masks_turn_and_shift() -> None:
    value = 0xE3069283
    assert masked(value) == (((value >> 15) | (value << 17 & 0xFFFFFFFF)) + 0xA282EAD8) % 2**32


names = st.text(min_size=1, max_size=8)
values = st.one_of(
    st.binary(max_size=40),
    st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=5),
    st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), min_size=1, max_size=5).map(
        lambda v: np.array(v, np.float32)
    ),
)


@settings(deadline=None)
@given(st.lists(st.dictionaries(names, values, max_size=4), max_size=3), st.booleans())
def test_what_was_written_is_read(tmp_path_factory, written, packed: bool) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path_factory.mktemp("records") / "a.tfrecord"
    path.write_bytes(b"".join(record(example(features, packed)) for features in written))
    found = list(read_examples(path))
    assert len(found) == len(written)
    for one, features in zip(found, written, strict=True):
        assert one.features.keys() == features.keys()
        for name, value in features.items():
            if isinstance(value, bytes):
                assert one.blob(name) == value
            elif isinstance(value, list):
                assert np.asarray(one.features[name]).tolist() == value
            else:
                assert one.numbers(name, len(value)).tobytes() == value.tobytes()


@settings(deadline=None)
@given(st.data())
def test_a_flipped_bit_is_found_wherever_it_is(tmp_path_factory, data: st.DataObject) -> None:  # type: ignore[no-untyped-def]
    whole = bytearray(record(b"some bytes") + record(b"more"))
    at = data.draw(st.integers(0, 8 * len(whole) - 1))
    whole[at // 8] ^= 1 << at % 8
    path = tmp_path_factory.mktemp("flipped") / "a.tfrecord"
    path.write_bytes(bytes(whole))
    with pytest.raises(DataError, match=r"record [01]: .*; (download|split)"):
        list(read_records(path))


@pytest.mark.parametrize("cut", [1, 5, 11, 12, 15, 21, 25])
def test_a_cut_file_is_named(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "a.tfrecord"
    path.write_bytes(record(b"some bytes")[:cut])
    with pytest.raises(DataError, match="record 0: the file ends"):
        list(read_records(path))


def test_a_record_of_a_terabyte_is_not_read(tmp_path: Path) -> None:
    head = struct.pack("<Q", 1 << 40)
    path = tmp_path / "a.tfrecord"
    path.write_bytes(head + struct.pack("<I", masked(crc32c(head))))
    with pytest.raises(DataError, match="claims 1099511627776 bytes"):
        list(read_records(path))
    with pytest.raises(DataError, match="cannot be read"):
        list(read_records(tmp_path / "none"))


@settings(deadline=None)
@given(st.binary(max_size=60))
def test_any_bytes_are_an_example_or_a_message(tmp_path_factory, data: bytes) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path_factory.mktemp("any") / "a.tfrecord"
    path.write_bytes(record(data))
    try:
        list(read_examples(path))
    except DataError as error:
        assert "no tf.train.Example" in str(error)


@pytest.mark.parametrize(
    "data, said",
    [
        (varint(1 << 3 | 2) + varint(50) + b"short", "50 bytes where 5 are left"),
        (varint(1 << 3 | 4), "wire type 4"),
        (b"\x80" * 11, "more than ten bytes"),
        (b"\x0a", "ends within a number"),
    ],
)
def test_bad_messages_are_named(tmp_path: Path, data: bytes, said: str) -> None:
    path = tmp_path / "a.tfrecord"
    path.write_bytes(record(data))
    with pytest.raises(DataError, match=said):
        list(read_examples(path))


def test_asking_for_something_else_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.tfrecord"
    path.write_bytes(record(example({"a": b"x", "b": [1, 2], "c": np.array([1.0, np.inf], np.float32)})))
    (one,) = read_examples(path)
    for call in (
        lambda: one.blob("b"),
        lambda: one.integer("b"),
        lambda: one.integer("none"),
        lambda: one.numbers("a"),
        lambda: one.numbers("c"),
        lambda: one.numbers("c", 3),
    ):
        with pytest.raises(DataError, match=r"a.tfrecord: record 0: \w+ holds .* is needed"):
            call()
