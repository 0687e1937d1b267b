"""PLY files as tables: elements by name, a row of numbers each, in either byte order or ASCII.

Elements with lists are passed over. trimesh would read meshes too, but keeps neither comments, nor unknown
properties, nor colours without alpha.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from . import base
from .base import Data

_DTYPE_OF_WORD = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}
"""Types by their words in a header, both of the first specification and of later programs."""
_WORD_OF_DTYPE = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
"""Words of the first specification, which every program reads."""
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
"""Put before a file that some editor took for text (Windows)."""
_ASCII = ["ascii", "1.0"]
"""Words of a format line, of text."""
_BINARY = (["binary_little_endian", "1.0"], ["binary_big_endian", "1.0"])
"""Words of a header's format line."""
_MIN_ASCII_BYTES = 2
"""A number of ASCII takes a digit and a space at least."""
_ROWS_PATTERN = re.compile(r"\d{1,12}")
"""A number of rows: a longer one is damage, and would be no number of bytes that a file can have."""


class Element(NamedTuple):
    """Rows of a file that have the same properties."""

    kind: np.dtype[np.void]
    """Without fields: lists, which are passed over."""
    rows: int
    offset: int

    def table(self, data: Data | bytearray) -> NDArray[np.void]:
        """The rows, in the file's own memory."""
        return np.frombuffer(data, self.kind, self.rows, self.offset)

    def names(self) -> tuple[str, ...]:
        """Properties in the order of the file."""
        return self.kind.names or ()


class Header(NamedTuple):
    """The lines of a file before its rows."""

    lines: list[list[str]]
    """Words of each line but the first and the last."""
    size: int
    """Bytes before the first row."""

    @property
    def form(self) -> list[str]:
        """Words of the format and its version; none where no line says them."""
        return next((words[1:] for words in self.lines if words[0] == "format"), [])

    @property
    def comments(self) -> list[list[str]]:
        """Words of the comments, with that before them."""
        found: list[list[str]] = []
        for words in self.lines:
            if words[0] in ("comment", "obj_info"):
                found.append(words)
        return found

    def has_property(self, name: str) -> bool:
        """True where any element has a property of that name."""
        return any(words[0] == "property" and words[-1] == name for words in self.lines)


class PlyTables(NamedTuple):
    """A file, taken apart."""

    data: Data
    """The file; of an ASCII one a binary file of the same elements."""
    header: Header
    """As it was read."""
    elements: dict[str, Element]


def read_tables(path: Path, data: Data) -> PlyTables:
    """The elements of a PLY. Raises DataError for what is none, and where rows are cut off."""
    header = read_header(data)
    if header is None:
        raise DataError(
            f"{path}: no PLY header from `ply` to `end_header`; the file is damaged or of another kind"
        )
    elements = _elements(path, data, header)
    if header.form == _ASCII:
        data, elements = _from_ascii(path, data, header, elements)
    return PlyTables(data, header, elements)


def read_header(data: Data) -> Header | None:
    """The header, whose lines end as the first one does: with LF, CR LF or CR; a mark of the byte order may stand before
    it. None where it has no begin or no end.
    """
    first = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\n|\r)", data)
    if first is None:
        return None
    newline = rb"\r" if first[1] == b"\r" else rb"\r?\n"
    end = re.compile(newline + rb"[ \t]*end_header[ \t]*" + newline).search(data, first.start(1))
    if end is None:
        return None
    words = []
    for line in re.split(newline, data[first.end() : max(first.end(), end.start())]):
        words.append(re.split(r"[ \t]+", line.decode("latin-1").strip(" \t")))
    return Header([each for each in words if each[0]], end.end())


def ply_file(
    tables: Mapping[str, NDArray[np.void]], antialiased: bool = False, comments: Sequence[str] = ()
) -> bytes:
    """A little-endian binary PLY of elements by name, a property a field; a field of (count, values) is a
    list.
    """
    head = ply_head(tables, antialiased, comments=comments)
    return head + b"".join(table.tobytes() for table in tables.values())


def ply_head(
    tables: Mapping[str, NDArray[np.void]],
    antialiased: bool,
    count: int | None = None,
    *,
    comments: Sequence[str] = (),
) -> bytes:
    """The header of `ply_file`, with lines of `comments`. `count` is the number of rows where the tables are
    samples.
    """
    lines = ["ply", "format binary_little_endian 1.0", *comments]
    if antialiased:
        lines.append("comment SplatRenderMode: mip")
    for name, table in tables.items():
        lines.append(f"element {name} {len(table) if count is None else count}")
        for field in table.dtype.names or ():
            kind = table.dtype[field]
            if kind.names is None:
                words = [_WORD_OF_DTYPE[kind.str[1:]]]
            else:
                words = ["list", *(_WORD_OF_DTYPE[kind[part].base.str[1:]] for part in kind.names)]
            lines.append(f"property {' '.join(words)} {field}")
    return "\n".join([*lines, "end_header", ""]).encode("latin-1")  # as headers are read


def with_comments(pieces: Iterable[bytes], comments: Sequence[str]) -> Iterator[bytes]:
    """Pieces of a file of `ply_file` or `ply_head` with further lines of comments."""
    lines = "".join(f"comment {text}\n" for text in comments).encode("latin-1")
    start = len(ply_head({}, False)) - len("end_header\n")
    for number, piece in enumerate(pieces):
        if number == 0:
            yield piece[:start] + lines + piece[start:]
        else:
            yield piece


class _Declared(NamedTuple):
    """An element as the header declares it."""

    name: str
    rows: int
    properties: list[str]
    kinds: list[list[str]]
    """Of each property its dtype, or those of a list's length and values."""

    @property
    def has_lists(self) -> bool:
        return any(len(of) > 1 for of in self.kinds)

    @property
    def table(self) -> np.dtype[np.void]:
        """The type of a row without lists."""
        return np.dtype([(name, of[0]) for name, of in zip(self.properties, self.kinds, strict=True)])


def _elements(path: Path, data: Data, header: Header) -> dict[str, Element]:
    """Elements by name, where they lie; those with lists are passed over. Those of ASCII files lie nowhere
    yet.
    """
    form = header.form
    is_ascii = form == _ASCII
    if form not in _BINARY and not is_ascii:
        raise DataError(
            f"{path}: a PLY of format {' '.join(form) or 'unknown'}; export it again as ascii or binary 1.0"
        )
    # Elements lie one after the other: each is passed over to find the next.
    offset = header.size
    elements = {}
    for declared in _declared(path, header):
        what = f"element {declared.name} of {declared.rows} rows"
        if declared.has_lists:
            if is_ascii:
                elements[declared.name] = Element(np.dtype([]), declared.rows, offset)
                continue
            if "vertex" in elements:
                # lists that follow the Gaussians may be cut, and the million faces of a mesh take seconds
                break
            after = _after_lists(data, offset, declared.rows, declared.kinds)
            if after is None:
                raise DataError(
                    f"{path}: {what} runs beyond the end of the file; copy it again, it is cut off or damaged"
                )
            offset = after
            continue
        table = declared.table
        if is_ascii:
            row_bytes = _MIN_ASCII_BYTES * len(declared.kinds)
        else:
            row_bytes = table.itemsize
        end = offset + declared.rows * row_bytes
        if end > len(data) + is_ascii:
            raise base.short(path, len(data), end, what)
        elements[declared.name] = Element(table, declared.rows, offset)
        offset = end
    return elements


def _declared(path: Path, header: Header) -> list[_Declared]:
    """The elements of a header, in order. Raises DataError where lines are no valid PLY."""
    types = dict(_DTYPE_OF_WORD)
    if "big" in header.form[0]:
        types = {name: kind.replace("<", ">") for name, kind in types.items()}
    lines = [words for words in header.lines if words[0] in ("element", "property")]
    starts = [number for number, words in enumerate(lines) if words[0] == "element"]
    declared = []
    for start, stop in zip(starts, [*starts[1:], len(lines)], strict=False):
        words = lines[start]
        properties = lines[start + 1 : stop]
        kinds = []
        names = []
        for each in properties:
            said = _kinds(each)
            known = []
            for kind in said:
                if kind in types:
                    known.append(types[kind])
            kinds.append(known)
            if known and len(known) == len(said):
                names.append(each[-1])
        sound = len(words) == 3 and _ROWS_PATTERN.fullmatch(words[2])
        if not sound or len({*names}) != len(properties) or not names:
            raise DataError(
                f"{path}: {' '.join(words)!r} or its properties are no valid PLY; export the file again"
            )
        declared.append(_Declared(words[1], int(words[2]), names, kinds))
    return declared


def _from_ascii(
    path: Path, data: Data, header: Header, elements: Mapping[str, Element]
) -> tuple[bytes, dict[str, Element]]:
    """A little-endian file of the elements of an ASCII one, a line a row; those with lists are left out."""
    lines = iter(data[header.size :].splitlines())
    tables: dict[str, NDArray[np.void]] = {}
    for name, element in elements.items():
        try:
            if element.names() and element.rows:
                # A row is a line; numbers are read as float64 and then rounded to their own type.
                numbers = np.loadtxt(lines, np.float64, comments=None, max_rows=element.rows, ndmin=2)
                if len(numbers) != element.rows:
                    raise ValueError(f"{len(numbers)} of {element.rows} rows")
                table = np.empty(element.rows, element.kind)
                for field, column in zip(element.names(), numbers.T, strict=True):
                    table[field] = column
                tables[name] = table
            elif not element.names():
                for _ in range(element.rows):
                    next(lines)
        except (ValueError, StopIteration) as error:
            raise DataError(
                f"{path}: the rows of element {name} are no numbers for its properties ({error})"
            ) from error
    # Comments go along, which may say what points up.
    whole = ply_file(tables, comments=[" ".join(words) for words in header.comments])
    binary = read_header(whole)
    assert binary is not None
    return whole, _elements(path, whole, binary)


def _kinds(words: list[str]) -> list[str]:
    """Types of a property: one, or those of a list's length and values; none where the line is neither."""
    if len(words) == 5 and words[1] == "list" and words[2] not in ("float", "float32", "double", "float64"):
        return words[2:4]
    return words[1:2] if len(words) == 3 else []


def _after_lists(data: Data, offset: int, count: int, fields: Sequence[Sequence[str]]) -> int | None:
    """End of rows with lists; None where that is beyond the end of the file."""
    for _ in range(count):
        for first, *values in fields:
            kind = np.dtype(first)
            if offset + kind.itemsize > len(data):
                return None
            extra = 0
            if values:
                length = int(np.frombuffer(data, kind, 1, offset)[0])
                extra = max(length, 0) * np.dtype(values[0]).itemsize
            offset += kind.itemsize + extra
        if offset > len(data):
            return None
    return offset
