"""San Francisco Mission Bay (Block-NeRF): TFRecord files of images with an origin and a direction for each
pixel.

Files whose name holds `val` or `test` are held out. Each record keeps `image` (PNG), `cam_idx`, `image_hash`,
`height`, `width`, `equivalent_exposure`, `ray_origins` and `ray_dirs`. Images are taken out once, into the
user's cache; what lies in a complete cache is not read again.

A file is a row of records: length (8 bytes), its masked CRC-32C, the bytes, their masked CRC-32C, all
little-endian. An Example is a protobuf message, read without TensorFlow: features (field 1) map a name to a
list of bytes (1), floats (2) or ints (3).

A camera is fitted to each image's rays: a pose, focal lengths, a principal point and OpenCV's k1 k2 p1 p2, to
a lattice of the rays, by OpenCV's calibration. What is left is told: a rolling shutter's rays come from many
places, and one pose is only their mean.
"""

import functools
import hashlib
import json
import math
import re
import shutil
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from ...errors import DataError, WriteError
from ...interfaces import DataParser
from ...io.atomic import atomic_path, write_json
from ...io.cache import cache_folder, reason_of, say_uncached, temporary_folder
from ...rendering.lens import OPENCV
from ..images import opened
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene, split_by
from .config import BlockNerfConfig, is_record
from .views import View, read_views, rigid_pose


@functools.cache
def _crc_kernel() -> Callable[[NDArray[np.uint8]], np.uint32]:
    """The loop over bytes, compiled at its first use."""
    import numba

    # The remainder of each byte by the reversed polynomial, bit after bit; then a step of the loop is one
    # look-up.
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(0x82F63B78), table >> 1).astype(np.uint32)

    @numba.njit(nogil=True)
    def run(data: NDArray[np.uint8]) -> np.uint32:
        state = np.uint32(0xFFFFFFFF)
        for byte in data:
            state = table[(state ^ byte) & np.uint32(0xFF)] ^ (state >> np.uint32(8))
        return state ^ np.uint32(0xFFFFFFFF)

    kernel: Callable[[NDArray[np.uint8]], np.uint32] = run
    return kernel


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli) of some bytes, in [0, 2**32)."""
    return int(_crc_kernel()(np.frombuffer(data, np.uint8)))


def masked(checksum: int) -> int:
    """The checksum as TFRecord files keep it: turned and offset, so that a checksum of checksums stays
    one.
    """
    return ((checksum >> 15 | checksum << 17) + 0xA282EAD8) & 0xFFFFFFFF


LONGEST = 1 << 30
"""Bytes that one record may claim: by eye, ten times what the largest have."""
_SCHEMA = """
name: "example.proto" package: "fprf" syntax: "proto3"
message_type { name: "bytes" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_BYTES } }
message_type { name: "floats" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_FLOAT } }
message_type { name: "integers" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_INT64 } }
message_type {
  name: "Feature" oneof_decl { name: "kind" }
  field { name: "bytes" number: 1 type: TYPE_MESSAGE type_name: ".fprf.bytes" oneof_index: 0 }
  field { name: "floats" number: 2 type: TYPE_MESSAGE type_name: ".fprf.floats" oneof_index: 0 }
  field { name: "integers" number: 3 type: TYPE_MESSAGE type_name: ".fprf.integers" oneof_index: 0 }
}
message_type {
  name: "Entry"
  field { name: "key" number: 1 type: TYPE_STRING }
  field { name: "value" number: 2 type: TYPE_MESSAGE type_name: ".fprf.Feature" }
}
message_type {
  name: "Features" field { name: "feature" number: 1 label: LABEL_REPEATED type: TYPE_MESSAGE type_name: ".fprf.Entry" }
}
message_type { name: "Example" field { name: "features" number: 1 type: TYPE_MESSAGE type_name: ".fprf.Features" } }
"""
"""tf.train.Example and what it consists of; a map is a list of entries in the file."""


class Example(NamedTuple):
    """One record, taken apart."""

    where: str
    """File and number of the record, to open messages with."""
    features: dict[str, tuple[str, Sequence[Any]]]
    """By name what each holds (byte strings, floats or integers), and these."""

    def blob(self, name: str) -> bytes:
        """The one byte string of a feature. Raises DataError."""
        return bytes(self._values(name, "byte strings", 1)[0])

    def integer(self, name: str) -> int:
        """The one integer of a feature. Raises DataError."""
        return int(self._values(name, "integers", 1)[0])

    def numbers(self, name: str, count: int) -> NDArray[np.float32]:
        """The floats of a feature, so many of them. Raises DataError, also where one is not finite."""
        numbers = np.array(self._values(name, "floats", count), np.float32)
        if not np.isfinite(numbers).all():
            raise DataError(
                f"{self.where}: {name} holds numbers that are not finite; download the file again"
            )
        return numbers

    def _values(self, name: str, kind: str, count: int) -> Sequence[Any]:
        held, values = self.features.get(name, (kind, ()))
        if held != kind or len(values) != count:
            raise DataError(
                f"{self.where}: {name} holds {f'{len(values)} {held}' if len(values) else 'nothing'}, needed: {count} {kind}; "
                "download the file again"
            )
        return values


def read_records(path: Path) -> Iterator[bytes]:
    """The records of a file, checksums verified. Raises DataError."""
    with opened(path) as file:
        number = 0
        while head := file.read(12):
            where = f"{path}: record {number}"
            if len(head) < 12:
                raise DataError(f"{where}: the file ends within its head; download it again")
            # A length that is wrong would make nonsense of everything behind it: it has a checksum of its
            # own.
            length, check = struct.unpack("<QI", head)
            if masked(crc32c(head[:8])) != check:
                raise DataError(f"{where}: the checksum of its length is wrong; download the file again")
            if length > LONGEST:
                raise DataError(f"{where}: claims {length} bytes, at most {LONGEST} are read; split the file")
            data = file.read(length)
            tail = file.read(4)
            if missing := length + 4 - len(data) - len(tail):
                raise DataError(f"{where}: the file ends {missing} bytes early; download it again")
            if masked(crc32c(data)) != struct.unpack("<I", tail)[0]:
                raise DataError(f"{where}: its checksum is wrong; download the file again")
            yield data
            number += 1


def read_examples(path: Path) -> Iterator[Example]:
    """The records of a file as Examples. Raises DataError."""
    for number, data in enumerate(read_records(path)):
        where = f"{path}: record {number}"
        try:
            message: Any = _message_class().FromString(data)
        except DecodeError as error:
            raise DataError(f"{where}: no tf.train.Example ({error}); convert the capture again") from error
        # Each feature is a list of one of three types, by its name; without one it is empty.
        features: dict[str, tuple[str, Sequence[Any]]] = {}
        for entry in message.features.feature:
            kind = entry.value.WhichOneof("kind") or "bytes"
            features[entry.key] = (
                "byte strings" if kind == "bytes" else kind,
                getattr(entry.value, kind).value,
            )
        yield Example(where, features)


@functools.cache
def _message_class() -> type[Message]:
    """The class of an Example, in a pool of its own: TensorFlow has the same in the common one."""
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(
        text_format.Parse(_SCHEMA, descriptor_pb2.FileDescriptorProto()).SerializeToString()
    )
    message: type[Message] = message_factory.GetMessageClass(pool.FindMessageTypeByName("fprf.Example"))
    return message


_LATTICE_RAYS = 24
"""Rays along each side of an image that a camera is fitted to: by eye."""


class RayCamera(NamedTuple):
    """A fitted camera; axes are OpenGL's."""

    pose: NDArray[np.float64]
    """Camera to world [3 4]."""
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float, float]
    """k1 k2 0 0 p1 p2."""
    error: float
    """Root mean square distance of the fitted pixels from the true ones."""


def fit_camera(origin: NDArray[np.float32], direction: NDArray[np.float32]) -> RayCamera:
    """The camera of rays [H W 3] through pixel centres. Raises ValueError where they are not those of any
    lens.
    """
    # Unit directions of a lattice of the rays, and their pixels.
    height, width = origin.shape[:2]
    lines = np.unique(np.linspace(0, height - 1, min(_LATTICE_RAYS, height)).round().astype(np.int64))
    columns = np.unique(np.linspace(0, width - 1, min(_LATTICE_RAYS, width)).round().astype(np.int64))
    grid = np.stack(np.meshgrid(columns, lines), -1).reshape(-1, 2)
    ray = direction[grid[:, 1], grid[:, 0]].astype(np.float64)
    long = np.linalg.norm(ray, axis=1, keepdims=True)
    if not (long > 1e-9).all() or len(grid) < 16:
        raise ValueError("rays without a direction, or too few of them")
    ray /= long
    pixel = grid.astype(np.float64) + 0.5
    angle = math.acos(np.clip(ray[0] @ ray[-1], -1, 1))
    if angle < 1e-6:
        raise ValueError("rays that span no image")
    # As many pixels a radian as along the diagonal are where the search begins.
    focal = np.linalg.norm(pixel[-1] - pixel[0]) / (2 * math.tan(angle / 2))
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    none = np.zeros(5)
    # Two points on each ray, near and far: only a camera in the rays' own place sees both in one pixel.
    points = np.concatenate([ray, 2 * ray]).astype(np.float32)
    seen = np.concatenate([pixel, pixel]).astype(np.float32)
    # k3 stays 0: what two radial and two tangential terms leave is told as the error.
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    try:
        error, matrix, bent, turns, _ = cv2.calibrateCamera(
            [points], [seen], (width, height), matrix, none, flags=flags
        )
    except cv2.error as fault:
        raise ValueError("rays that no lens makes") from fault
    if not (matrix.diagonal() > 0).all():
        raise ValueError("rays of a mirrored image")
    turn = cv2.Rodrigues(turns[0])[0]
    place = origin.reshape(-1, 3).mean(0, dtype=np.float64)
    axes = np.stack([turn[0], -turn[1], -turn[2]], 1)
    k1, k2, p1, p2, _ = bent.reshape(-1).tolist()
    return RayCamera(
        np.concatenate([axes, place[:, None]], 1),
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        (k1, k2, 0.0, 0.0, p1, p2),
        float(error),
    )


_VIEWS_FORMAT = 1
"""Number of the form of views.json: raise it when the same files give other entries."""


class BlockNerfParser(DataParser):
    """TFRecord files in a folder."""

    def __init__(self, config: BlockNerfConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of the stored size. Raises DataError naming file and record."""
        files = sorted(path for path in data.rglob("*") if is_record(path.name) and path.is_file())
        if not files:
            raise DataError(f"{data}: no *.tfrecord files here or below; name the folder that they lie in")
        # By what tells files apart without reading hundreds of gigabytes: place, size and time.
        facts = []
        for f in files:
            facts.append((str(f.relative_to(data)), f.stat().st_size, f.stat().st_mtime_ns))
        key = hashlib.sha256(json.dumps([str(data.resolve()), facts]).encode()).hexdigest()[:12]
        folder, entries = _unpack(data, files, f"blocknerf-{key}")
        # Of the cameras that are asked for, if they are cameras.
        chosen = []
        for e in entries:
            if not self.config.cameras or e["camera"] in self.config.cameras:
                chosen.append(e)
        if not chosen:
            present = sorted({e["camera"] for e in entries})
            raise DataError(
                f"{data}: no images of cameras {list(self.config.cameras)}; parser.cameras may name {present}"
            )
        chosen.sort(key=lambda entry: str(entry["name"]))
        worst = max(chosen, key=lambda entry: float(entry["error"]))
        if worst["error"] > self.config.tolerance:
            raise DataError(
                f"{data}: the rays of {worst['name']} are {worst['error']:.2g} pixels from those of any camera, "
                f"parser.tolerance is {self.config.tolerance:g}; raise it, or leave out its camera with parser.cameras"
            )
        views, kept, notes = read_views(data, chosen, lambda entry: _view(folder, entry))
        split = split_by([entry["held"] for entry in kept])
        contents = CaptureContents(views=views, split=split, notes=notes)
        return assemble_scene(data, contents, downscale=downscale)


def _unpack(data: Path, files: list[Path], name: str) -> tuple[Path, list[dict[str, Any]]]:
    """The folder of images taken out of the records, once, and what is known of each view.

    In folder NAME of the cache; where that has no room, in one that ends with this process.
    """
    folder = cache_folder(name)
    entries = _unpacked(folder)
    if entries:
        return folder, entries
    try:
        return folder, _take_out(data, files, folder)
    except WriteError as error:
        say_uncached(folder, reason_of(error))
        shutil.rmtree(folder, ignore_errors=True)  # half of the images is of no use, and needs the room
        temporary = temporary_folder(name)
        if temporary is None or temporary == folder:
            raise
        return temporary, _take_out(data, files, temporary)


def _take_out(data: Path, files: list[Path], folder: Path) -> list[dict[str, Any]]:
    """Write the images of all records into a folder. Raises WriteError where the system refuses."""
    entries = []
    for file in files:
        held = re.search("val|test", str(file.relative_to(data)).lower()) is not None
        for example in read_examples(file):
            entries.append(_entry(example, folder, held))
    write_json(folder / "views.json", {"format": _VIEWS_FORMAT, "views": entries})
    return entries


def _unpacked(folder: Path) -> list[dict[str, Any]]:
    """The views of a complete cache; none where it is not complete."""
    try:
        document = json.loads((folder / "views.json").read_text())
        entries: list[dict[str, Any]] = document["views"]
        complete = document["format"] == _VIEWS_FORMAT and all(
            (folder / "images" / f"{e['name']}.png").is_file() for e in entries
        )
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return entries if complete else []


def _entry(example: Example, folder: Path, held: bool) -> dict[str, Any]:
    """Writes the image; what is known of its camera."""
    height = example.integer("height")
    width = example.integer("width")
    if not (4 <= height <= 10**5 and 4 <= width <= 10**5):
        raise DataError(f"{example.where}: an image of {width}x{height} pixels; download the file again")
    origin = example.numbers("ray_origins", 3 * height * width).reshape(height, width, 3)
    direction = example.numbers("ray_dirs", 3 * height * width).reshape(height, width, 3)
    try:
        camera = fit_camera(origin, direction)
    except ValueError as error:
        raise DataError(
            f"{example.where}: its rays are not those of a camera ({error}); leave its file out"
        ) from error
    exposure = float(example.numbers("equivalent_exposure", 1)[0])
    if exposure <= 0:
        raise DataError(
            f"{example.where}: equivalent_exposure is {exposure}, it must be above 0; leave its file out"
        )
    # The image under a name that says its camera.
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
        exposure=entry["exposure"],
    )
