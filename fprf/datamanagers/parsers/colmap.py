"""COLMAP sparse models, binary or text, to scenes.

Every count in a binary file is checked against the bytes that remain before anything is allocated, and every error says
where in the file it was found.

COLMAP's lenses become ours; its world-to-camera poses in OpenCV axes become camera-to-world in OpenGL's. The world frame
is kept. Each view's depths are the 0.1 and 99.9 percentile of the points that it observes (LLFF's rule).
"""

import struct
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ...rendering.lens import FISHEYE, OPENCV, PINHOLE
from ...rendering.splines import rotations
from ..scene import Scene
from .config import ColmapConfig
from .files import path_inside, read_bytes, read_npz
from .views import View, assemble_scene, pixel_size, quaternion_rotation, rigid_pose

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
        suffix, cameras_of, images_of, points_of = "bin", _cameras_bin, _images_bin, _points_bin
    else:
        suffix, cameras_of, images_of, points_of = "txt", _cameras_txt, _images_txt, _points_txt
    cloud = folder / f"points3D.{suffix}"
    cameras, images = cameras_of(folder / f"cameras.{suffix}"), images_of(folder / f"images.{suffix}")
    ids, points = points_of(cloud) if cloud.is_file() else (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    return ColmapModel(cameras, images, ids, points)


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
        numbers = file.take(struct.Struct(f"<{params}d"), "its parameters")
        cameras[int(id_)] = ColmapCamera(name, int(width), int(height), numbers)
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
        cameras[id_] = ColmapCamera(words[1], width, height, _floats(path, place, words[4:]))
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


_APART = 1e-3
"""Share of the cameras' extent by which the two sets of camera centres may differ."""

Cloud = tuple[NDArray[np.float64], NDArray[np.int64] | None]
"""Finite points [P 3], and pairs [O 2] where known."""


def observed_points(model: ColmapModel, images: Sequence[ColmapImage]) -> list[NDArray[np.int64]]:
    """Rows of the model's points that each image observes; ids that are not in the model are left out."""
    order = np.argsort(model.point_ids, kind="stable")
    observed = []
    for image in images:
        at = np.searchsorted(model.point_ids, image.observed, sorter=order)
        inside = at < len(order)
        row = order[at[inside]]
        observed.append(row[model.point_ids[row] == image.observed[inside]])
    return observed


def cloud_of_images(model: ColmapModel, observed: Sequence[NDArray[np.int64]]) -> Cloud:
    """Finite points of a model, and the pairs of views, in the order of `observed`, and points, each once."""
    views = [np.unique(rows) for rows in observed]
    pairs = np.stack([np.repeat(np.arange(len(views)), [len(rows) for rows in views]), np.concatenate(views)], 1)
    return _finite(model.points, pairs.astype(np.int64))


def _finite(points: NDArray[np.float64], seen: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The points that are finite, and their pairs."""
    finite = np.asarray(np.isfinite(points).all(1))
    view, point = seen[finite[seen[:, 1]]].T
    return points[finite], np.stack([view, (np.cumsum(finite) - 1)[point]], 1)


def cloud_of_model(folder: Path, names: Sequence[str], poses: Sequence[NDArray[np.float64]]) -> Cloud | None:
    """The points of a model whose images are these views, by file name and place; None where it is another's."""
    model = read_model(folder)
    images = {PurePosixPath(image.name).name: image for image in model.images}
    files = [PurePosixPath(name).name for name in names]
    if not len(model.points) or len(set(files)) < len(files) or not set(files) <= images.keys():
        return None
    ordered = [images[file] for file in files]
    here = np.stack([pose[:, 3] for pose in poses])
    turn = rotations(torch.tensor([image.quaternion for image in ordered], dtype=torch.float64)).numpy()
    offset = np.array([image.translation for image in ordered])
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.abs(-np.einsum("vji,vj->vi", turn, offset) - here).max()
    extent = np.ptp(here, axis=0).max() if len(here) > 1 else 1.0
    return cloud_of_images(model, observed_points(model, ordered)) if apart <= _APART * extent else None


def read_cloud(path: Path, views: int) -> Cloud:
    """`xyz` and, where there is one, `seen` of a points.npz; points that are not finite are left out."""
    xyz = read_npz(path, "xyz")
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise DataError(f"{path}: xyz has shape {xyz.shape}, not [P 3]; write it again or remove the file")
    with zipfile.ZipFile(path) as archive:
        if "seen.npy" not in archive.namelist():
            return xyz[np.asarray(np.isfinite(xyz).all(1))], None
    seen = read_npz(path, "seen")
    if seen.ndim != 2 or seen.shape[1] != 2 or not ((seen >= 0) & (seen < (views, len(xyz)))).all():
        raise DataError(f"{path}: seen is no [O 2] of {views} views and {len(xyz)} points; write it again or leave it out")
    return _finite(xyz, seen.astype(np.int64))


_Lens: TypeAlias = tuple[tuple[float, float], tuple[float, float], tuple[float, float, float, float, float, float], int]


def model_folder(data: Path) -> Path | None:
    """Folder of the sparse model, or None."""
    for folder in (data / "sparse" / "0", data / "sparse", data):
        if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
            return folder
    return None


class ColmapParser(DataParser):
    """A sparse model and the folder of its images."""

    def __init__(self, config: ColmapConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene at 1/downscale of the size of the images in the chosen folder."""
        folder = model_folder(data)
        if folder is None:
            raise DataError(f"{data}: no cameras.bin or cameras.txt in sparse/0, sparse or here; run COLMAP's mapper")
        model = read_model(folder)
        if not model.images:
            raise DataError(f"{folder}: the model has no images; run COLMAP's mapper again")
        name, root = path_inside(data, "parser.images", self.config.images)
        lenses = {id_: _lens(f"{folder}: camera {id_}", camera) for id_, camera in model.cameras.items()}
        named = [(*path_inside(root, f"{folder}: image {image.name!r}", image.name), image) for image in model.images]
        named.sort(key=lambda each: each[0])
        observed = observed_points(model, [image for _, _, image in named])
        views = []
        for (inner, path, image), rows in zip(named, observed, strict=True):
            where = f"{folder}: image {image.name!r}"
            if image.camera not in lenses:
                raise DataError(f"{where}: its camera {image.camera} is not in the model; export the model again")
            camera = model.cameras[image.camera]
            focal, centre, distortion, lens = lenses[image.camera]
            pose = _pose(where, image)
            views.append(
                View(
                    name=inner,
                    path=path,
                    pose=pose,
                    size=(camera.width, camera.height),
                    focal=focal,
                    centre=centre,
                    distortion=distortion,
                    lens=lens,
                    depths=_depths(model.points[rows], pose),
                )
            )
        twice = [a.name for a, b in pairwise(views) if a.name == b.name]
        if twice:
            raise DataError(f"{folder}: the image {twice[0]!r} is registered twice; export the model again")
        points, seen = cloud_of_images(model, observed)
        return assemble_scene(data, views, downscale=downscale, points=points, seen=seen, reduced=name != "images")


def _pose(where: str, image: ColmapImage) -> NDArray[np.float64]:
    back = quaternion_rotation(where, image.quaternion).T
    # A damaged translation may overflow; `rigid_pose` refuses what is not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        centre = -back @ np.array(image.translation)
    return rigid_pose(where, np.stack([back[:, 0], -back[:, 1], -back[:, 2], centre], 1))


def _lens(where: str, camera: ColmapCamera) -> _Lens:
    """Focal lengths, principal point, k1 k2 k3 k4 p1 p2 and lens of a COLMAP camera."""
    p = camera.params
    pixel_size(where, camera.width, camera.height)
    shared = camera.model.startswith("SIMPLE") or camera.model in ("RADIAL", "RADIAL_FISHEYE")
    focal, centre, k = ((p[0], p[0]), (p[1], p[2]), p[3:]) if shared else ((p[0], p[1]), (p[2], p[3]), p[4:])
    match camera.model:
        case "SIMPLE_PINHOLE" | "PINHOLE":
            return focal, centre, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), PINHOLE
        case "SIMPLE_RADIAL" | "SIMPLE_RADIAL_FISHEYE":
            bent = (k[0], 0.0, 0.0, 0.0, 0.0, 0.0)
        case "RADIAL" | "RADIAL_FISHEYE":
            bent = (k[0], k[1], 0.0, 0.0, 0.0, 0.0)
        case "OPENCV":
            bent = (k[0], k[1], 0.0, 0.0, k[2], k[3])
        case "OPENCV_FISHEYE":
            bent = (k[0], k[1], k[2], k[3], 0.0, 0.0)
        case "FULL_OPENCV" if not any(k[5:]):
            bent = (k[0], k[1], k[4], 0.0, k[2], k[3])
        case _:
            raise DataError(
                f"{where}: the lens {camera.model} with parameters {list(k)} cannot be represented; "
                "run `colmap image_undistorter` and use its output"
            )
    return focal, centre, bent, FISHEYE if camera.model.endswith("FISHEYE") else OPENCV if any(bent) else PINHOLE


def _depths(points: NDArray[np.float64], pose: NDArray[np.float64]) -> tuple[float, float] | None:
    """Bounds of the depths of the points that an image observes; None where they are too few for a percentile."""
    # Damaged coordinates may overflow; what is not finite is left out.
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (points - pose[:, 3]) @ -pose[:, 2]
    depth = depth[np.isfinite(depth) & (depth > 0)]
    near, far = np.percentile(depth, (0.1, 99.9)) if len(depth) >= 8 else (0.0, 0.0)
    return (float(near), float(far)) if 0 < near < far else None
