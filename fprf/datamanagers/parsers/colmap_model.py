"""COLMAP sparse models: cameras, images and points, binary or text, to plain records. No interpretation of either.

Every count in a binary file is checked against the bytes that remain before anything is allocated, and every error says
where in the file it was found. Camera and image tables are small; observations are kept as arrays.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from .files import read_bytes

__all__ = ["MODELS", "ColmapCamera", "ColmapImage", "ColmapModel", "read_model"]

MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
"""Name and number of parameters, in the order of COLMAP's model ids."""


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
        cloud = folder / "points3D.bin"
        cameras = _cameras_bin(folder / "cameras.bin")
        images = _images_bin(folder / "images.bin")
        ids, points = _points_bin(cloud) if cloud.is_file() else _no_points()
    else:
        cloud = folder / "points3D.txt"
        cameras = _cameras_txt(folder / "cameras.txt")
        images = _images_txt(folder / "images.txt")
        ids, points = _points_txt(cloud) if cloud.is_file() else _no_points()
    return ColmapModel(cameras, images, ids, points)


def _no_points() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    return np.zeros(0, dtype=np.int64), np.zeros((0, 3))


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
        values = layout.unpack_from(self.data, self.at)
        self.at += layout.size
        return values

    def count(self, least: int, what: str) -> int:
        """A count of things that take at least `least` bytes each."""
        number = int(self.take(_COUNT, f"the number of {what}")[0])
        self.need(number * least, f"{number} {what}")
        return number

    def end(self) -> None:
        if self.at != len(self.data):
            raise self.error(f"{len(self.data) - self.at} bytes too many")


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def _camera(model: str, numbers: tuple[float, ...], params: tuple[float, ...]) -> ColmapCamera:
    return ColmapCamera(model, int(numbers[0]), int(numbers[1]), params)


def _cameras_bin(path: Path) -> dict[int, ColmapCamera]:
    file = _Bytes(path)
    cameras: dict[int, ColmapCamera] = {}
    for _ in range(file.count(_CAMERA.size, "cameras")):
        id_, model, width, height = file.take(_CAMERA, "a camera")
        if not 0 <= model < len(MODELS):
            raise file.error(f"camera model {model} is unknown, 0 to {len(MODELS) - 1} are known")
        if id_ in cameras:
            raise file.error(f"camera {id_} occurs twice")
        name, params = MODELS[int(model)]
        cameras[int(id_)] = _camera(name, (width, height), file.take(struct.Struct(f"<{params}d"), "its parameters"))
    file.end()
    return cameras


def _images_bin(path: Path) -> list[ColmapImage]:
    file = _Bytes(path)
    images = []
    for _ in range(file.count(_IMAGE.size + 1 + _COUNT.size, "images")):
        _, qw, qx, qy, qz, tx, ty, tz, camera = file.take(_IMAGE, "an image")
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
        images.append(ColmapImage(name, int(camera), (qw, qx, qy, qz), (tx, ty, tz), point[point >= 0].astype(np.int64)))
    file.end()
    return images


def _points_bin(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    file = _Bytes(path)
    count = file.count(_POINT.size + _COUNT.size, "points")
    ids, points = np.zeros(count, dtype=np.int64), np.zeros((count, 3))
    for k in range(count):
        id_, *xyz, _, _, _, _ = file.take(_POINT, "a point")
        ids[k] = min(int(id_), np.iinfo(np.int64).max)
        points[k] = xyz
        track = file.count(8, "track elements")
        file.at += 8 * track
    file.end()
    return ids, points


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """The place and text of each line that is no comment; empty ones too."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _bad(path, f"byte {error.start}", "not UTF-8 text") from error
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.lstrip().startswith("#"):
            yield f"line {number}", line.strip()


def _floats(path: Path, place: str, words: list[str]) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in words)
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


def _cameras_txt(path: Path) -> dict[int, ColmapCamera]:
    known = dict(MODELS)
    cameras: dict[int, ColmapCamera] = {}
    for place, line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) < 4 or words[1] not in known or len(words) != 4 + known[words[1]]:
            raise _bad(path, place, "not `ID MODEL WIDTH HEIGHT` and as many parameters as a known model has")
        id_, width, height = _ints(path, place, [words[0], *words[2:4]])
        if id_ in cameras:
            raise _bad(path, place, f"camera {id_} occurs twice")
        cameras[id_] = _camera(words[1], (width, height), _floats(path, place, words[4:]))
    return cameras


def _images_txt(path: Path) -> list[ColmapImage]:
    images = []
    lines = _lines(path)
    for place, line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        if len(words) != 10:
            raise _bad(path, place, "not `ID QW QX QY QZ TX TY TZ CAMERA NAME`")
        qw, qx, qy, qz, tx, ty, tz = _floats(path, place, words[1:8])
        _, camera = _ints(path, place, [words[0], words[8]])
        below, features = next(lines, (place, ""))
        cells = features.split()
        if len(cells) % 3:
            raise _bad(path, below, f"{len(cells)} numbers are no multiple of the three `X Y POINT3D_ID` of a feature")
        point = np.array(_ints(path, below, cells[2::3]), dtype=np.int64)
        images.append(ColmapImage(words[9], camera, (qw, qx, qy, qz), (tx, ty, tz), point[point >= 0]))
    return images


def _points_txt(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    ids: list[int] = []
    points: list[tuple[float, ...]] = []
    for place, line in _lines(path):
        words = line.split()
        if not words:
            continue
        if len(words) < 8:
            raise _bad(path, place, "not `ID X Y Z R G B ERROR` and a track")
        ids += _ints(path, place, words[:1])
        points.append(_floats(path, place, words[1:4]))
    return np.array(ids, dtype=np.int64), np.array(points, dtype=np.float64).reshape(-1, 3)
