"""Untrusted files of a scene folder: JSON and its records, paths that stay inside, NumPy arrays without
pickle, PLY points.

Whatever the bytes, the outcome is a value or a DataError of one line; nothing is allocated on a file's word
alone. Links inside the folder are followed: only what a file *says* must stay inside.
"""

import glob
import io
import math
import os
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import TypeAlias

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ...errors import DataError
from ...io.strict_json import parse_json
from ..images import IMAGE_SUFFIXES
from ..picture_names import spelling

Json: TypeAlias = "dict[str, Json] | list[Json] | str | int | float | bool | None"

_MAX_ARRAY = 1 << 32
"""Bytes that an array inside an archive may unpack to: by eye, as many as a machine of today holds."""
_MAX_ARCHIVE_RATIO = 1032
"""Times its size that deflated data may unpack to: the format's limit."""
_MAX_JSON_NUMBER = 1e300
"""Numbers of JSON beyond it are refused: their products would overflow."""
_MAX_SHOWN = 60
"""Characters of a wrong value that a message repeats: by eye."""


def read_bytes(path: Path) -> bytes:
    """The whole file; DataError where it cannot be read."""
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error


_NOT_FINITE = re.compile(r'"(?:[^"\\]|\\.)*"|[+-]?\b(nan(?:\(\w*\))?|inf(?:inity)?|1\.#\w+)', re.IGNORECASE)
"""Strings of JSON, which are left alone, and what C++ writes of numbers that are not finite: -nan(ind), inf,
1.#QNAN.
"""


def read_json(path: Path) -> Json:
    """The JSON value of a file (see `parse_json`), numbers that are not finite included, however they are
    written.
    """
    data = read_bytes(path)
    try:
        # Strict first: only where that fails is the text searched for what C++ writes instead of numbers.
        text = data.decode("utf-8-sig")
        try:
            value: Json = parse_json(text, nan=True)
        except ValueError:
            value = parse_json(_NOT_FINITE.sub(lambda found: "NaN" if found[1] else found[0], text), nan=True)
    except ValueError as error:
        raise DataError(
            f"{path}: no valid JSON ({error}); write it again with the tool it came from"
        ) from error
    return value


def read_float(text: str) -> float:
    """A number as text; NaN for what C++ writes of those that are not finite. Raises ValueError for anything
    else.
    """
    if _NOT_FINITE.fullmatch(text):
        return math.nan
    return float(text)


_CONTROL = re.compile("[\0-\x08\n-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""Ends of lines, terminals' commands, and what UTF-8 cannot hold."""


def path_inside(root: Path, where: str, text: str) -> tuple[str, Path]:
    """A path that a file gives, relative to `root` or absolute: its normal form with slashes, and the whole
    path.

    Raises DataError, opened by `where`, for paths that leave `root`, for none, and for control characters.
    """
    if control := _CONTROL.search(text):
        raise DataError(
            f"{where}: the path {text!r} has the control character {control[0]!r} in it; rename the file"
        )
    # A backslash is Windows' slash, except where a file is called so.
    if "\\" in text and os.path.lexists(os.path.join(root, text)):
        name = text
    else:
        name = text.replace("\\", "/")
    foreign = os.name != "nt" and PureWindowsPath(text).is_absolute()
    for top in (os.path.abspath(root), os.path.realpath(root)):
        whole = Path(os.path.normpath(os.path.join(top, name)))
        if whole.is_relative_to(top) and not foreign:
            parts = whole.relative_to(top).parts
            if not parts:
                raise DataError(
                    f"{where}: the path {text!r} names no file; give one inside of {root}, like images/0001.png"
                )
            return "/".join(parts), root.joinpath(*parts)
    raise DataError(f"{where}: the path {text!r} leaves {root}; give paths inside, like images/0001.png")


def reduced_copies(folder: Path) -> Path | None:
    """The folder of the copies of a folder's images that are reduced least, such as images_2; None where there is
    none with images in it.
    """
    pattern = re.compile(re.escape(folder.name) + "_([0-9]{1,4})")
    factors: dict[int, Path] = {}
    for path in folder.parent.glob(f"{glob.escape(folder.name)}_*"):
        match = pattern.fullmatch(path.name)
        if match and holds_images(path):
            factors[int(match[1])] = path
    return factors[min(factors)] if factors else None


def holds_images(folder: Path) -> bool:
    """True for a folder with an image in it or below."""
    return any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.rglob("*"))


def image_folder(folder: Path) -> tuple[Path, list[str]]:
    """A folder of images, and no note; where it is not there or holds none, the copies that are reduced least, and
    a note that says so.
    """
    copies = None
    if not holds_images(folder):
        copies = reduced_copies(folder)
    if copies is None:
        return folder, []
    return copies, [f"{folder} is not there: {copies} is read"]


class NamedFiles:
    """Files inside a folder by the names that a capture gives them, which other systems may have spelt
    another way, or whose folder may be there as reduced copies alone (images_4).
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.notes: list[str] = []
        """A line for each folder that is read instead of another."""
        self._factors: dict[Path, int] = {}
        self._folders: dict[Path, Path] = {}
        self._listed: dict[Path, dict[str, str]] = {}

    def find(self, where: str, text: str, suffixes: frozenset[str] = frozenset()) -> tuple[str, Path]:
        """The path as `path_inside` gives it, and where no such file is, that of the one file whose name
        differs in case, outer blanks or Unicode's normal form (macOS), or by one of `suffixes`, in lower
        case, that the path lacks.
        """
        name, path = path_inside(self.root, where, text)
        if os.path.lexists(path):
            return name, path
        if path.parent not in self._folders:
            self._folders[path.parent] = self._folder(path.parent)
        folder = self._folders[path.parent]
        if folder not in self._listed:
            self._listed[folder] = _names_in(folder)
        listed = self._listed[folder]
        found = listed.get(spelling(path.name))
        if found is None and folder != path.parent:  # copies may be of another format
            found = listed.get(spelling(path.stem))
            return name, path if not found else folder / found
        if not found:
            return name, path
        missing = ""
        if spelling(found) != spelling(path.name):
            missing = os.path.splitext(found)[1]
            if missing.lower() not in suffixes:
                return name, path
        return name + missing, folder / found

    def _folder(self, folder: Path) -> Path:
        """The folder, or where it or one above is not there, what is below its reduced copies."""
        current = self.root
        for part in folder.relative_to(self.root).parts:
            wanted = current / part
            current, said = image_folder(wanted)
            self.notes += said
            if current != wanted:
                self._factors[current] = int(current.name.rpartition("_")[2])
        return current

    def factor(self, path: Path) -> int:
        """Reduction of the copy that is read instead of an image; 1 for an image itself."""
        return next((self._factors[folder] for folder in path.parents if folder in self._factors), 1)


def _names_in(folder: Path) -> dict[str, str]:
    """The files of a folder by their spelling, and images by that without the suffix."""
    listed: dict[str, str] = {}
    names = os.listdir(folder) if folder.is_dir() else []
    for entry in sorted(names, key=lambda name: (not name.lower().endswith(".png"), name)):  # PNG before JPEG
        whole = spelling(entry)
        suffix = os.path.splitext(entry)[1]
        # Two files of one spelling are told apart by nothing: neither is found.
        listed[whole] = "" if whole in listed else entry
        if suffix.lower() in IMAGE_SUFFIXES:
            listed.setdefault(spelling(entry[: -len(suffix)]), entry)
    return listed


def read_ply_points(path: Path) -> tuple[NDArray[np.float64] | None, list[str]]:
    """The finite positions [P 3] of a PLY file, text or binary; where there are none, None and a note that
    says why.
    """
    from trimesh.exchange.ply import load_ply

    try:
        # All kinds of PLY have one reader, which is tried on any bytes.
        points = np.array(load_ply(io.BytesIO(read_bytes(path)))["vertices"], dtype=np.float64).reshape(-1, 3)
    except DataError as fault:
        return None, [f"points are not read: {fault}"]
    except Exception as error:  # whatever trimesh makes of the bytes
        return None, [
            f"points are not read: {path}: no PLY file with points ({' '.join(str(error).split())[:80]})"
        ]
    points = points[np.isfinite(points).all(1)]
    if len(points):
        return (points, [])
    return (None, [f"points are not read: {path}: holds none"])


def name_of(data: Path) -> str:
    """A scene's name: its folder's."""
    return data.resolve().name or "scene"


def read_npy(where: str, data: bytes) -> NDArray[np.float64]:
    """The numbers of a .npy file as float64; DataError, opened by `where`, for anything but a whole numeric
    array.
    """
    stream = io.BytesIO(data)
    try:
        version = npy.read_magic(stream)
        if version == (1, 0):
            read_header = npy.read_array_header_1_0
        else:
            read_header = npy.read_array_header_2_0
        shape, fortran, dtype = read_header(stream)
    except Exception as error:  # the header is a literal of Python, and says so in many ways
        raise DataError(
            f"{where}: no NumPy array ({' '.join(str(error).split())[:80]}); write it with numpy.save"
        ) from error
    # The header's word must fit the bytes that follow, before anything is made of them.
    count = math.prod(shape)
    held = len(data) - stream.tell()
    if dtype.kind not in "fiu" or min(shape, default=0) < 0 or count * dtype.itemsize != held:
        raise DataError(
            f"{where}: the header says {shape} of {dtype}, but {held} bytes follow; numbers are read: write them with "
            "numpy.save, or copy the file again"
        )
    numbers = np.frombuffer(data, dtype=dtype, offset=stream.tell(), count=count)
    return np.array(numbers.reshape(shape, order="F" if fortran else "C"), dtype=np.float64, order="C")


def read_npz(path: Path, key: str) -> NDArray[np.float64]:
    """One array of a .npz archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            entry = archive.getinfo(f"{key}.npy")
            if entry.file_size > _MAX_ARRAY:
                raise DataError(
                    f"{path}: {key} claims {entry.file_size} bytes; at most {_MAX_ARRAY} are read: thin it out"
                )
            # What is claimed is allocated before it is read.
            held = path.stat().st_size
            if entry.compress_size > held or entry.file_size > _MAX_ARCHIVE_RATIO * held:
                raise DataError(
                    f"{path}: {key} claims {entry.file_size} bytes, but the file has {held}; copy it again"
                )
            data = archive.read(entry)
    except KeyError as error:
        raise DataError(
            f"{path}: no array {key!r} in it; write it with numpy.savez(..., {key}=...)"
        ) from error
    except (
        OSError,
        ValueError,
        EOFError,
        RuntimeError,
        zipfile.BadZipFile,
        zlib.error,
        OverflowError,
    ) as error:
        raise DataError(
            f"{path}: no readable .npz archive ({error}); write it again with numpy.savez"
        ) from error
    return read_npy(f"{path}: {key}", data)


@dataclass(frozen=True)
class Record:
    """One JSON object; what it lacks is looked up in `common`."""

    where: str
    """File and place, the start of every message."""
    own: dict[str, Json]
    common: dict[str, Json]

    def get(self, key: str) -> Json:
        """The value, or None where it is absent or null."""
        value = self.own.get(key)
        return self.common.get(key) if value is None else value

    def number(self, key: str) -> float | None:
        """A number, finite or not, or None where it is absent."""
        value = self.get(key)
        number = _number(value)
        if value is not None and number is None:
            raise self._wrong(key, "a number")
        return number

    def needed(self, key: str) -> float:
        """A number that must be there."""
        value = self.number(key)
        if value is None:
            raise DataError(f"{self.where}: {key} is missing; export the capture again")
        return value

    def text(self, key: str) -> str | None:
        """A string, or None where it is absent."""
        value = self.get(key)
        if value is not None and not isinstance(value, str):
            raise self._wrong(key, "a string")
        return value

    def texts(self, key: str) -> list[str] | None:
        """A list of strings, or None where it is absent."""
        value = self.get(key)
        if value is None:
            return None
        if isinstance(value, list):
            strings = []
            for item in value:
                if isinstance(item, str):
                    strings.append(item)
        else:
            strings = []
        if not isinstance(value, list) or len(strings) != len(value):
            raise self._wrong(key, "of strings alone" if isinstance(value, list) else "a list of strings")
        return strings

    def numbers(self, key: str, count: int) -> NDArray[np.float64]:
        """A list of `count` numbers, finite or not."""
        numbers = _numbers(self.get(key), count)
        if numbers is None:
            raise self._wrong(key, f"{count} numbers")
        return np.array(numbers)

    def table(self, key: str, width: int) -> NDArray[np.float64]:
        """A list of one or more rows of `width` numbers, finite or not."""
        value = self.get(key)
        if isinstance(value, list):
            rows = []
            for row in value:
                rows.append(_numbers(row, width))
        else:
            rows = []
        if not rows or None in rows:
            raise self._wrong(key, f"rows of {width} numbers")
        return np.array(rows, dtype=np.float64)

    def matrix(self, key: str) -> NDArray[np.float64]:
        """A list of 3 or 4 rows of 4 numbers."""
        rows = self.table(key, 4)
        if len(rows) not in (3, 4):
            raise self._wrong(key, "3 or 4 rows of 4 numbers")
        return rows

    def _wrong(self, key: str, wanted: str) -> DataError:
        return DataError(
            f"{self.where}: {key} is {_short(self.get(key))}, not {wanted}; correct it, or export it again"
        )

    def records(self, key: str) -> "list[Record]":
        """A list of objects, each falling back to this one."""
        value = self.own.get(key)
        if not isinstance(value, list) or not value:
            raise DataError(
                f"{self.where}: no list of {key}, or an empty one; an entry for each image is needed"
            )
        found = []
        for k, item in enumerate(value):
            found.append(as_record(f"{self.where}: {key}[{k}]", item, self.own))
        return found


def _number(value: Json) -> float | None:
    """A number of JSON as float64, finite or not; None for anything else, and beyond 1e300, where products
    overflow.
    """
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or _MAX_JSON_NUMBER < abs(value) < math.inf
    ):
        return None
    return float(value)


def _numbers(value: Json, count: int) -> list[float] | None:
    """The numbers, finite or not, of a list of `count`; None for anything else."""
    cells = value if isinstance(value, list) else []
    numbers = []
    for number in map(_number, cells):
        if number is not None:
            numbers.append(number)
    if len(numbers) == len(cells) == count:
        return numbers
    return None


def as_record(where: str | Path, value: Json, common: dict[str, Json] | None = None) -> Record:
    """A record of a JSON value, which must be an object."""
    if not isinstance(value, dict):
        raise DataError(f"{where}: {_short(value)} instead of an object in braces; correct it")
    return Record(str(where), value, common or {})


def _short(value: Json) -> str:
    if value is None:
        return "missing"
    if not isinstance(value, dict | list):
        text = repr(value)
    elif isinstance(value, list):
        text = "a list"
    else:
        text = "an object"
    if len(text) <= _MAX_SHOWN:
        return text
    return text[: _MAX_SHOWN - 3] + "..."
