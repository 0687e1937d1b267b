"""TFRecord files of tf.train.Example, read without TensorFlow.

A file is a row of records: length (8 bytes), its masked CRC-32C, the bytes, their masked CRC-32C, all little-endian. An Example
is a protobuf message: a map of names to lists of bytes, floats or integers. Every length is checked against what is left before
anything is taken, and every message says where it was found.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from .checksum import crc32c, masked

__all__ = ["Example", "Feature", "read_examples", "read_records"]

LONGEST = 1 << 30
"""Bytes that one record may claim."""
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5

Feature: TypeAlias = "list[bytes] | NDArray[np.float32] | NDArray[np.int64]"


class Example(NamedTuple):
    """One record, taken apart."""

    where: str
    """File and number of the record, to open messages with."""
    features: dict[str, Feature]

    def blob(self, name: str) -> bytes:
        """The one byte string of a feature. Raises DataError."""
        value = self.features.get(name)
        if not isinstance(value, list) or len(value) != 1:
            raise self._wrong(name, "one byte string")
        return value[0]

    def integer(self, name: str) -> int:
        """The one integer of a feature. Raises DataError."""
        value = self.features.get(name)
        if isinstance(value, list) or value is None or value.dtype != np.int64 or len(value) != 1:
            raise self._wrong(name, "one integer")
        return int(value[0])

    def numbers(self, name: str, count: int | None = None) -> NDArray[np.float32]:
        """The floats of a feature, so many of them. Raises DataError, also where one is not finite."""
        value = self.features.get(name)
        if isinstance(value, list) or value is None or value.dtype != np.float32:
            raise self._wrong(name, "floats")
        if (count is not None and len(value) != count) or not np.isfinite(value).all():
            raise self._wrong(name, f"{'some' if count is None else count} finite floats")
        return value.astype(np.float32)

    def _wrong(self, name: str, wanted: str) -> DataError:
        value = self.features.get(name)
        found = "nothing" if value is None else f"{len(value)} {'byte strings' if isinstance(value, list) else value.dtype}"
        return DataError(f"{self.where}: {name} holds {found}, {wanted} is needed; download the file again")


def read_records(path: Path) -> Iterator[bytes]:
    """The records of a file, checksums verified. Raises DataError."""
    try:
        with path.open("rb") as file:
            number = 0
            while head := file.read(12):
                where = f"{path}: record {number}"
                if len(head) < 12:
                    raise DataError(f"{where}: the file ends within its head; download it again")
                length, check = struct.unpack("<QI", head)
                if masked(crc32c(head[:8])) != check:
                    raise DataError(f"{where}: the checksum of its length is wrong; download the file again")
                if length > LONGEST:
                    raise DataError(f"{where}: claims {length} bytes, at most {LONGEST} are read; split the file")
                data, tail = file.read(length), file.read(4)
                if len(data) < length or len(tail) < 4:
                    raise DataError(
                        f"{where}: the file ends {length + 4 - len(data) - len(tail)} bytes early; download it again"
                    )
                if masked(crc32c(data)) != struct.unpack("<I", tail)[0]:
                    raise DataError(f"{where}: its checksum is wrong; download the file again")
                yield data
                number += 1
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from error


def read_examples(path: Path) -> Iterator[Example]:
    """The records of a file as Examples. Raises DataError."""
    for number, data in enumerate(read_records(path)):
        where = f"{path}: record {number}"
        try:
            yield Example(where, _example(memoryview(data)))
        except ValueError as error:
            raise DataError(f"{where}: no tf.train.Example ({error}); convert the capture again") from error


def _example(data: memoryview) -> dict[str, Feature]:
    found: dict[str, Feature] = {}
    for features in _children(data, 1):
        for entry in _children(features, 1):
            names, values = list(_children(entry, 1)), list(_children(entry, 2))
            if len(names) != 1:
                raise ValueError("a feature without a name")
            name = bytes(names[0]).decode("utf-8")
            found[name] = _feature(values[-1]) if values else []
    return found


def _feature(data: memoryview) -> Feature:
    for number, kind, value, _ in _fields(data):
        if kind != _BYTES:
            raise ValueError(f"a feature of wire type {kind}")
        if number == 1:
            return [bytes(each) for each in _children(value, 1)]
        if number == 2:
            return _floats(value)
        if number == 3:
            return _integers(value)
    return []


def _floats(data: memoryview) -> NDArray[np.float32]:
    parts = []
    for number, kind, value, _ in _fields(data):
        if number == 1 and kind in (_BYTES, _FOUR):
            if len(value) % 4:
                raise ValueError(f"packed floats of {len(value)} bytes")
            parts.append(np.frombuffer(value, "<f4"))
    return np.concatenate(parts).astype(np.float32) if parts else np.zeros(0, np.float32)


def _integers(data: memoryview) -> NDArray[np.int64]:
    found = []
    for number, kind, value, whole in _fields(data):
        if number == 1 and kind == _VARINT:
            found.append(whole)
        elif number == 1 and kind == _BYTES:
            at = 0
            while at < len(value):
                whole, at = _varint(value, at)
                found.append(whole)
    return np.array(found, dtype=np.uint64).astype(np.int64)


def _children(data: memoryview, number: int) -> Iterator[memoryview]:
    """Length-delimited fields of a number."""
    for own, kind, value, _ in _fields(data):
        if own == number and kind == _BYTES:
            yield value


def _fields(data: memoryview) -> Iterator[tuple[int, int, memoryview, int]]:
    """Number, wire type, bytes and (of a varint) value of each field of a message."""
    at, none = 0, data[:0]
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            whole, at = _varint(data, at)
            yield number, kind, none, whole
            continue
        if kind == _BYTES:
            size, at = _varint(data, at)
        elif kind in (_EIGHT, _FOUR):
            size = 8 if kind == _EIGHT else 4
        else:
            raise ValueError(f"wire type {kind} at byte {at}")
        if size > len(data) - at:
            raise ValueError(f"a field of {size} bytes where {len(data) - at} are left")
        yield number, kind, data[at : at + size], 0
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for place in range(10):
        if at >= len(data):
            raise ValueError("it ends within a number")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << (7 * place)
        if byte < 0x80:
            return value & 0xFFFFFFFFFFFFFFFF, at
    raise ValueError("a number of more than ten bytes")
