"""San Francisco Mission Bay (Block-NeRF): TFRecord files of images with an origin and a direction for each pixel.

Files whose name holds `val` or `test` are held out. Each record keeps `image` (PNG), `cam_idx`, `image_hash`, `height`,
`width`, `equivalent_exposure`, `ray_origins` and `ray_dirs`. Images are taken out once, into the user's cache; what lies in a
complete cache is not read again.

A file is a row of records: length (8 bytes), its masked CRC-32C, the bytes, their masked CRC-32C, all little-endian. An Example
is a protobuf message, read without TensorFlow: features (field 1) map a name to a list of bytes (1), floats (2) or ints (3).

A camera is fitted to each image's rays: a pose, focal lengths, a principal point and OpenCV's k1 k2 p1 p2, to a lattice of the
rays, by damped least squares on pixels. What is left is told: a rolling shutter's rays come from many places, and one pose is
only their mean.
"""

import functools
import hashlib
import json
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ...io.atomic import atomic_path, write_json
from ...rendering.lens import OPENCV
from ..scene import Scene
from .config import BlockNerfConfig
from .town import cache_folder
from .views import View, assemble_scene, read_views, rigid_pose, split_by

_POLYNOMIAL = 0x82F63B78
_MASK = 0xA282EAD8


@functools.cache
def _crc_kernel() -> Callable[[NDArray[np.uint8], NDArray[np.uint32]], np.uint32]:
    """The loop over bytes, compiled at its first use."""
    import numba

    @numba.njit(cache=True, nogil=True)
    def run(data: NDArray[np.uint8], table: NDArray[np.uint32]) -> np.uint32:
        state = np.uint32(0xFFFFFFFF)
        for byte in data:
            state = table[(state ^ byte) & np.uint32(0xFF)] ^ (state >> np.uint32(8))
        return state ^ np.uint32(0xFFFFFFFF)

    kernel: Callable[[NDArray[np.uint8], NDArray[np.uint32]], np.uint32] = run
    return kernel


@functools.cache
def _crc_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_POLYNOMIAL), table >> 1).astype(np.uint32)
    return table


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli) of some bytes, in [0, 2**32)."""
    return int(_crc_kernel()(np.frombuffer(data, np.uint8), _crc_table()))


def masked(checksum: int) -> int:
    """The checksum as TFRecord files keep it: turned and offset, so that a checksum of checksums stays one."""
    return ((checksum >> 15 | checksum << 17) + _MASK) & 0xFFFFFFFF


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
        actual = "nothing" if value is None else f"{len(value)} {'byte strings' if isinstance(value, list) else value.dtype}"
        return DataError(f"{self.where}: {name} holds {actual}, {wanted} is needed; download the file again")


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
    record: dict[str, Feature] = {}
    for features in _children(data, 1):
        for entry in _children(features, 1):
            names, values = list(_children(entry, 1)), list(_children(entry, 2))
            if len(names) != 1:
                raise ValueError("a feature without a name")
            name = bytes(names[0]).decode("utf-8")
            record[name] = _feature(values[-1]) if values else []
    return record


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
    numbers = []
    for number, kind, value, whole in _fields(data):
        if number == 1 and kind == _VARINT:
            numbers.append(whole)
        elif number == 1 and kind == _BYTES:
            at = 0
            while at < len(value):
                whole, at = _varint(value, at)
                numbers.append(whole)
    return np.array(numbers, dtype=np.uint64).astype(np.int64)


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


Array = NDArray[np.float64]
_LATTICE = 24
"""Rays along each side that are looked at."""
_ROUNDS = 30


class RayCamera(NamedTuple):
    """A fitted camera; axes are OpenGL's."""

    pose: Array
    """Camera to world [3 4]."""
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float, float]
    """k1 k2 0 0 p1 p2."""
    error: float
    """Root mean square distance of the fitted pixels from the true ones."""
    drift: float
    """Largest distance of a ray's origin from the pose's."""


def fit_camera(origin: NDArray[np.float32], direction: NDArray[np.float32]) -> RayCamera:
    """The camera of rays [H W 3] through pixel centres. Raises ValueError where they are not those of any lens."""
    height, width = origin.shape[:2]
    rows = np.unique(np.linspace(0, height - 1, min(_LATTICE, height)).round().astype(np.int64))
    columns = np.unique(np.linspace(0, width - 1, min(_LATTICE, width)).round().astype(np.int64))
    grid = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    ray = direction[grid[:, 1], grid[:, 0]].astype(np.float64)
    long = np.linalg.norm(ray, axis=1, keepdims=True)
    if not (long > 1e-9).all() or len(grid) < 16:
        raise ValueError("rays without a direction, or too few of them")
    ray /= long
    pixel = grid.astype(np.float64) + 0.5
    turn = _axes(ray, grid)
    local = ray @ turn.T
    if not (local[:, 2] > 0.02).all():
        raise ValueError("rays that look backwards: more than a half space in one image")
    plane = local[:, :2] / local[:, 2:]
    # Straight lines first: focal lengths and centre of a pinhole.
    (fx, cx), (fy, cy) = (np.polyfit(plane[:, a], pixel[:, a], 1) for a in range(2))
    if not (fx > 0 and fy > 0):
        raise ValueError("rays of a mirrored image")
    best = _refine(local, pixel, np.array([0.0, 0.0, 0.0, fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0]))
    turned = cv2.Rodrigues(best[:3])[0] @ turn
    place = origin.reshape(-1, 3).astype(np.float64)
    middle = place.mean(0)
    axes = np.stack([turned[0], -turned[1], -turned[2]], 1)
    fx, fy, cx, cy, k1, k2, p1, p2 = best[3:].tolist()
    return RayCamera(
        np.concatenate([axes, middle[:, None]], 1),
        (fx, fy),
        (cx, cy),
        (k1, k2, 0.0, 0.0, p1, p2),
        float(np.sqrt(((_project(local, best)[0] - pixel) ** 2).sum(1).mean())),
        float(np.linalg.norm(place - middle, axis=1).max()),
    )


def _axes(ray: Array, grid: NDArray[np.int64]) -> Array:
    """Rows: right, down and forward, as the corners of the lattice say."""
    x, y = grid[:, 0], grid[:, 1]
    left, right = ray[x == x.min()].mean(0), ray[x == x.max()].mean(0)
    above, below = ray[y == y.min()].mean(0), ray[y == y.max()].mean(0)
    ahead = np.cross(right - left, below - above)
    if np.linalg.norm(ahead) < 1e-9:
        raise ValueError("rays that span no image")
    ahead /= np.linalg.norm(ahead)
    if ahead @ ray.mean(0) < 0:
        raise ValueError("rays of a mirrored image")
    across = (right - left) - ((right - left) @ ahead) * ahead
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(ahead, across), ahead])


def _refine(local: Array, pixel: Array, value: Array) -> Array:
    """Levenberg and Marquardt's steps: eleven numbers, a few hundred rays."""

    def miss(value: Array) -> tuple[Array, Array]:
        pixels, slope = _project(local, value)
        return np.nan_to_num(pixels - pixel, nan=1e6, posinf=1e6, neginf=-1e6).reshape(-1), slope

    damping = 1e-3
    error, slope = miss(value)
    for _ in range(_ROUNDS):
        normal = slope.T @ slope
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(11), -slope.T @ error)
        tried, slope_tried = miss(value + step)
        if (tried**2).sum() < (error**2).sum():
            gained = 1 - (tried**2).sum() / max((error**2).sum(), 1e-300)
            value, error, slope, damping = value + step, tried, slope_tried, damping / 10
            if gained < 1e-9:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    return value


def _project(local: Array, value: Array) -> tuple[Array, Array]:
    """Pixels [N 2] of rays in OpenCV's camera axes, and their slopes [2N 11], by rotation vector, fx fy cx cy, k1 k2 p1 p2."""
    fx, fy, cx, cy = value[3:7]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixels, slope = cv2.projectPoints(local[:, None], value[:3], np.zeros(3), matrix, value[7:])
    slope = np.delete(slope, (3, 4, 5), axis=1)  # those of the translation
    return pixels[:, 0].astype(np.float64), slope.astype(np.float64)


_FORMAT = 1


def record_files(data: Path) -> list[Path]:
    """The TFRecord files of a folder and its folders, by name."""
    return sorted(path for path in data.rglob("*") if is_record(path.name) and path.is_file())


def is_record(name: str) -> bool:
    """Return whether a file name is that of a TFRecord file or of one of its shards."""
    return re.search(r"\.tfrecord(-\d+-of-\d+)?$", name) is not None


class BlockNerfParser(DataParser):
    """TFRecord files in a folder."""

    def __init__(self, config: BlockNerfConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene at 1/downscale of the stored size. Raises DataError naming file and record."""
        files = record_files(data)
        if not files:
            raise DataError(f"{data}: no *.tfrecord files here or below; name the folder that they lie in")
        folder = cache_folder() / f"blocknerf-{_key(data, files)}"
        entries = _unpacked(folder)
        if entries is None:
            entries = [entry for file in files for entry in _unpack(file, data, folder)]
            write_json(folder / "views.json", {"format": _FORMAT, "views": entries})
        chosen = [e for e in entries if not self.config.cameras or e["camera"] in self.config.cameras]
        if not chosen:
            present = sorted({e["camera"] for e in entries})
            raise DataError(f"{data}: no images of cameras {list(self.config.cameras)}; parser.cameras may name {present}")
        chosen.sort(key=lambda entry: str(entry["name"]))
        worst = max(chosen, key=lambda entry: float(entry["error"]))
        if worst["error"] > self.config.tolerance:
            raise DataError(
                f"{data}: the rays of {worst['name']} are {worst['error']:.2g} pixels from those of any camera, "
                f"parser.tolerance is {self.config.tolerance:g}; raise it, or leave out its camera with parser.cameras"
            )
        views, kept, notes = read_views(data, chosen, lambda entry: _view(folder, entry))
        split = split_by([entry["held"] for entry in kept])
        scene = assemble_scene(data, views, downscale=downscale, split=split, notes=notes)
        return replace(scene, exposure=torch.tensor([entry["exposure"] for entry in kept], dtype=torch.float64))


def _key(data: Path, files: list[Path]) -> str:
    """By what tells files apart without reading hundreds of gigabytes: place, size and time."""
    facts = [(str(f.relative_to(data)), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    return hashlib.sha256(json.dumps([str(data.resolve()), facts]).encode()).hexdigest()[:12]


def _unpacked(folder: Path) -> list[dict[str, Any]] | None:
    """The views of a complete cache."""
    try:
        document = json.loads((folder / "views.json").read_text())
        entries: list[dict[str, Any]] = document["views"]
        complete = document["format"] == _FORMAT and all((folder / "images" / f"{e['name']}.png").is_file() for e in entries)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return entries if complete else None


def _unpack(file: Path, data: Path, folder: Path) -> list[dict[str, Any]]:
    held = bool(re.search("val|test", str(file.relative_to(data)).lower()))
    (folder / "images").mkdir(parents=True, exist_ok=True)
    return [_entry(example, folder, held) for example in read_examples(file)]


def _entry(example: Example, folder: Path, held: bool) -> dict[str, Any]:
    """Writes the image; what is known of its camera."""
    height, width = example.integer("height"), example.integer("width")
    if not (4 <= height <= 10**5 and 4 <= width <= 10**5):
        raise DataError(f"{example.where}: an image of {width}x{height} pixels; download the file again")
    count = 3 * height * width
    shape = (height, width, 3)
    origin = example.numbers("ray_origins", count).reshape(shape)
    direction = example.numbers("ray_dirs", count).reshape(shape)
    try:
        camera = fit_camera(origin, direction)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise DataError(f"{example.where}: its rays are not those of a camera ({error}); leave its file out") from error
    exposure = float(example.numbers("equivalent_exposure", 1)[0])
    if exposure <= 0:
        raise DataError(f"{example.where}: equivalent_exposure is {exposure}, it must be above 0; leave its file out")
    index = example.integer("cam_idx")
    # Hashes are unsigned: neither a minus nor an order by size belongs in a file's name.
    name = f"cam{index:02d}-{example.integer('image_hash') & 0xFFFFFFFFFFFFFFFF:016x}"
    with atomic_path(folder / "images" / f"{name}.png") as temporary:
        temporary.write_bytes(example.blob("image"))
    return {
        "name": name,
        "camera": index,
        "held": held,
        "exposure": exposure,
        "size": [width, height],
        **camera._asdict(),
        "pose": camera.pose.tolist(),
    }


def _view(folder: Path, entry: dict[str, Any]) -> View:
    return View(
        name=entry["name"],
        path=folder / "images" / f"{entry['name']}.png",
        pose=rigid_pose(entry["name"], np.array(entry["pose"])),
        size=tuple(entry["size"]),
        focal=tuple(entry["focal"]),
        centre=tuple(entry["centre"]),
        distortion=tuple(entry["distortion"]),
        lens=OPENCV,
    )
