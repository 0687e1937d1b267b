"""COLMAP sparse models as they lie on disk, binary or text: cameras, images and points.

Every count in a binary file is checked against the bytes that remain before anything is allocated, and every
error says where in the file it was found.
"""

import contextlib
import shlex
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from .config import model_folders
from .files import read_bytes, read_float

MODELS = (
    ("SIMPLE_PINHOLE", "f cx cy"),
    ("PINHOLE", "fx fy cx cy"),
    ("SIMPLE_RADIAL", "f cx cy k1"),
    ("RADIAL", "f cx cy k1 k2"),
    ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    ("FOV", "fx fy cx cy omega"),
    ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2"),
    ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 k3 k4 k5 k6 p1 p2 s1 s2 s3 s4"),
    ("SIMPLE_DIVISION", "f cx cy division"),
    ("DIVISION", "fx fy cx cy division"),
    ("SIMPLE_FISHEYE", "f cx cy"),
    ("FISHEYE", "fx fy cx cy"),
    ("EUCM", "fx fy cx cy alpha beta"),
    ("EQUIRECTANGULAR", "w h"),
)
"""Name and parameters, in the order of COLMAP's model ids (4.2); k1 to k4 are the polynomial's, d1 to d3 a
denominator's.
"""


@dataclass(frozen=True)
class ColmapCamera:
    """A camera: its model's name, size in pixels and parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: world-to-camera rotation (unit quaternion w x y z) and translation, OpenCV axes."""

    name: str
    camera: int
    quaternion: tuple[float, float, float, float]
    translation: tuple[float, float, float]
    observed: NDArray[np.int64]
    """Ids of the points that its features belong to."""


@dataclass(frozen=True)
class ColmapModel:
    """A whole model; images in the file's order."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    point_ids: NDArray[np.int64]
    points: NDArray[np.float64]
    """[P 3] in the world, in the order of `point_ids`."""


def read_model(folder: Path) -> ColmapModel:
    """The model in a folder: `cameras` and `images`, and `points3D` if it is there, .bin before .txt."""
    if (folder / "cameras.bin").is_file():
        suffix = "bin"
        cameras_of = _cameras_bin
        images_of = _images_bin
        points_of = _points_bin
    else:
        suffix = "txt"
        cameras_of = _cameras_txt
        images_of = _images_txt
        points_of = _points_txt
    cameras: dict[int, ColmapCamera] = {}
    for place, id_, camera in cameras_of(folder / f"cameras.{suffix}"):
        if id_ in cameras:
            raise _bad(folder / f"cameras.{suffix}", place, f"camera {id_} occurs twice")
        cameras[id_] = camera
    # Points may be absent: some tools write cameras and images alone.
    cloud = folder / f"points3D.{suffix}"
    images = list(images_of(folder / f"images.{suffix}"))
    points = np.fromiter(
        points_of(cloud) if cloud.is_file() else (), np.dtype([("id", "i8"), ("xyz", "f8", 3)])
    )
    return ColmapModel(cameras, images, points["id"], points["xyz"])


def _bad(path: Path, place: str, finding: str) -> DataError:
    return DataError(f"{path}: {place}: {finding}; copy the model again or export it again from COLMAP")


class _Bytes:
    """A cursor over a binary file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.at = 0

    def error(self, finding: str) -> DataError:
        return _bad(self.path, f"byte {self.at}", finding)

    def need(self, count: int, what: str) -> None:
        left = len(self.data) - self.at
        if count > left:
            raise self.error(f"{what} needs {count} bytes, {left} are left")

    def take(self, layout: struct.Struct, what: str) -> tuple[float, ...]:
        self.need(layout.size, what)
        self.at += layout.size
        return layout.unpack_from(self.data, self.at - layout.size)

    def count(self, least: int, what: str) -> int:
        """A count of things that take at least `least` bytes each."""
        number = int(self.take(_COUNT, f"the number of {what}")[0])
        self.need(number * least, f"{number} {what}")
        return number

    def end(self) -> None:
        if self.at != len(self.data):
            raise self.error(f"{len(self.data) - self.at} bytes too many")


_COUNT = struct.Struct("<Q")
_CAMERA_LAYOUT = struct.Struct("<IiQQ")
_IMAGE_LAYOUT = struct.Struct("<I7dI")
_POINT_LAYOUT = struct.Struct("<Q3d3Bd")
# A feature's place in pixels, and the id of its point, -1 for none.
_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def _cameras_bin(path: Path) -> Iterator[tuple[str, int, ColmapCamera]]:
    file = _Bytes(path)
    for _ in range(file.count(_CAMERA_LAYOUT.size, "cameras")):
        # Models are numbers in these files, and their count of parameters follows from them.
        id_, model, width, height = file.take(_CAMERA_LAYOUT, "a camera")
        if not 0 <= model < len(MODELS):
            raise file.error(
                f"camera model {model} is unknown, 0 to {len(MODELS) - 1} are known; {undistort_remedy(path.parent)}"
            )
        name, params = MODELS[int(model)]
        numbers = file.take(struct.Struct(f"<{len(params.split())}d"), "its parameters")
        yield f"byte {file.at}", int(id_), ColmapCamera(name, int(width), int(height), numbers)
    file.end()


def _images_bin(path: Path) -> Iterator[ColmapImage]:
    file = _Bytes(path)
    for _ in range(file.count(_IMAGE_LAYOUT.size + 1 + _COUNT.size, "images")):
        _, qw, qx, qy, qz, tx, ty, tz, camera = file.take(_IMAGE_LAYOUT, "an image")
        # A name that ends with a zero byte, then the features, of which the points are kept.
        stop = file.data.find(b"\0", file.at)
        if stop < 0:
            raise file.error("the image's name does not end")
        try:
            name = file.data[file.at : stop].decode("utf-8")
        except UnicodeDecodeError as error:
            raise file.error("the image's name is not UTF-8") from error
        file.at = stop + 1
        count = file.count(_FEATURE.itemsize, "features")
        point = np.frombuffer(file.data, dtype=_FEATURE, count=count, offset=file.at)["point"]
        file.at += count * _FEATURE.itemsize
        yield ColmapImage(
            name, int(camera), (qw, qx, qy, qz), (tx, ty, tz), point[point >= 0].astype(np.int64)
        )
    file.end()


def _points_bin(path: Path) -> Iterator[tuple[int, tuple[float, ...]]]:
    file = _Bytes(path)
    for _ in range(file.count(_POINT_LAYOUT.size + _COUNT.size, "points")):
        id_, *xyz, _, _, _, _ = file.take(_POINT_LAYOUT, "a point")
        track = file.count(8, "track elements")
        file.at += 8 * track
        yield min(int(id_), np.iinfo(np.int64).max), tuple(xyz)
    file.end()


def _rows(path: Path) -> Iterator[tuple[str, list[str]]]:
    """The place and words of each line that is neither a comment nor empty."""
    return ((place, line.split()) for place, line in _lines(path) if line.strip())


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """The place and text of each line that is no comment; empty ones too. Blanks at its end may belong to a
    name.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _bad(path, f"byte {error.start}", "not UTF-8 text") from error
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.lstrip().startswith("#"):
            yield f"line {number}", line.rstrip("\r")


def _floats(path: Path, place: str, words: list[str]) -> tuple[float, ...]:
    try:
        return tuple(read_float(word) for word in words)
    except ValueError as error:
        raise _bad(path, place, f"not numbers ({error})") from error


def _ints(path: Path, place: str, words: list[str]) -> tuple[int, ...]:
    try:
        values = tuple(int(word) for word in words)
    except ValueError as error:
        raise _bad(path, place, f"not whole numbers ({error})") from error
    if values and not -(2**63) < min(values) <= max(values) < 2**63:
        raise _bad(path, place, "a number beyond 64 bits")
    return values


def _cameras_txt(path: Path) -> Iterator[tuple[str, int, ColmapCamera]]:
    known = dict(MODELS)
    for place, words in _rows(path):
        if len(words) >= 4 and words[1].isidentifier() and words[1] not in known:
            raise DataError(
                f"{path}: {place}: the camera model {words[1]} is unknown; {undistort_remedy(path.parent)}"
            )
        if len(words) < 4 or words[1] not in known or len(words) != 4 + len(known[words[1]].split()):
            raise _bad(path, place, "not `ID MODEL WIDTH HEIGHT` and as many parameters as the model has")
        id_, width, height = _ints(path, place, [words[0], *words[2:4]])
        yield place, id_, ColmapCamera(words[1], width, height, _floats(path, place, words[4:]))


def _images_txt(path: Path) -> Iterator[ColmapImage]:
    lines = _lines(path)
    for place, line in lines:
        # The name is the rest of the line; as bytes only ASCII's blanks part words, of which a name may begin
        # with others.
        words = []
        for word in line.encode().split(maxsplit=9):
            words.append(word.decode())
        if not words:
            continue
        if len(words) != 10:
            raise _bad(path, place, "not `ID QW QX QY QZ TX TY TZ CAMERA NAME`")
        qw, qx, qy, qz, tx, ty, tz = _floats(path, place, words[1:8])
        _, camera = _ints(path, place, [words[0], words[8]])
        below, features = next(lines, (place, ""))
        cells = features.split()
        if len(cells) % 3:
            raise _bad(
                path,
                below,
                f"{len(cells)} numbers are no multiple of the three `X Y POINT3D_ID` of a feature",
            )
        point = np.array(_ints(path, below, cells[2::3]), dtype=np.int64)
        yield ColmapImage(words[9], camera, (qw, qx, qy, qz), (tx, ty, tz), point[point >= 0])


def _points_txt(path: Path) -> Iterator[tuple[int, tuple[float, ...]]]:
    for place, words in _rows(path):
        if len(words) < 8:
            raise _bad(path, place, "not `ID X Y Z R G B ERROR` and a track")
        yield _ints(path, place, words[:1])[0], _floats(path, place, words[1:4])


def undistort_remedy(folder: Path, images: str = "IMAGES") -> str:
    """The remedy for lenses that cannot be represented."""
    paths = f"--image_path {shlex.quote(images)} --input_path {shlex.quote(str(folder))} --output_path UNDISTORTED"
    return f"undistort the images with `colmap image_undistorter {paths}` and give the folder UNDISTORTED"


def largest_model(data: Path) -> tuple[Path | None, list[str]]:
    """Folder of the sparse model with the most images, the first of equals, and a note where there are
    several.
    """
    folders = model_folders(data)
    if len(folders) < 2:
        return next(iter(folders), None), []
    # What the models claim to have; nothing where a file cannot be read.
    counts = dict.fromkeys(folders, 0)
    for folder in folders:
        with contextlib.suppress(OSError, DataError):
            if (folder / "cameras.bin").is_file():
                with (folder / "images.bin").open("rb") as file:
                    counts[folder] = int.from_bytes(file.read(_COUNT.size), "little")
            else:
                counts[folder] = sum(1 for _ in _lines(folder / "images.txt")) // 2
    largest = max(folders, key=lambda folder: counts[folder])
    told = ", ".join(f"{folder.relative_to(data)} ({count})" for folder, count in counts.items())
    return largest, [f"of the models {told} that of the most images is read: {largest.relative_to(data)}"]
