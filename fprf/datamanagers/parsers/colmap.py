"""COLMAP sparse models, binary or text, to scenes.

Every count in a binary file is checked against the bytes that remain before anything is allocated, and every
error says where in the file it was found.

COLMAP's lenses become ours; its world-to-camera poses in OpenCV axes become camera-to-world in OpenGL's. The
world frame is kept. Each view's depths are the 0.1 and 99.9 percentile of the points that it observes (LLFF's
rule).
"""

import contextlib
import itertools
import shlex
import struct
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ...rendering.splines import rotations
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene, index_tensor
from .config import ColmapConfig, model_folders
from .files import NamedFiles, image_folder, path_inside, read_bytes, read_float, read_npz, read_ply_points
from .views import View, lens_of, pixel_size, quaternion_rotation, read_views, rigid_pose

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
                f"camera model {model} is unknown, 0 to {len(MODELS) - 1} are known; {_undistort(path.parent)}"
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
                f"{path}: {place}: the camera model {words[1]} is unknown; {_undistort(path.parent)}"
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


_MAX_CENTRE_OFFSET = 1e-3
"""Share of the cameras' extent by which the two sets of camera centres may differ: text of four digits (by eye)."""
_MIN_DEPTHS = 8
"""Points that an image observes below which percentiles of their depths say nothing: by eye."""
_DEPTH_PERCENTILES = (0.1, 99.9)
"""LLFF's bounds of depths, in percent."""

Cloud = tuple[NDArray[np.float64], NDArray[np.int64] | None]
"""Finite points [P 3], and pairs [O 2] where known."""


def observed_points(model: ColmapModel, images: Sequence[ColmapImage]) -> list[NDArray[np.int64]]:
    """Rows of the model's points that each image observes; ids that are not in the model are left out."""
    # By binary search among the sorted ids.
    order = np.argsort(model.point_ids, kind="stable")
    ids = model.point_ids[order]
    observed = []
    for image in images:
        at = np.searchsorted(ids, image.observed)
        inside = at < len(ids)
        at = at[inside]
        observed.append(order[at[ids[at] == image.observed[inside]]])
    return observed


def cloud_of_images(model: ColmapModel, observed: Sequence[NDArray[np.int64]]) -> Cloud:
    """Finite points of a model, and the pairs of views, in the order of `observed`, and points, each once."""
    # A view may observe a point with several features.
    views = []
    for rows in observed:
        views.append(np.unique(rows))
    pairs = np.stack(
        [np.repeat(np.arange(len(views)), [len(rows) for rows in views]), np.concatenate(views)], 1
    )
    return _finite(model.points, pairs.astype(np.int64))


def _finite(
    points: NDArray[np.float64], seen: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The points that are finite, and their pairs."""
    finite = np.asarray(np.isfinite(points).all(1))
    view, point = seen[finite[seen[:, 1]]].T
    return points[finite], np.stack([view, (np.cumsum(finite) - 1)[point]], 1)


def cloud_of_model(
    data: Path, views: Sequence[View], applied: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.int64] | None, list[str]]:
    """The points of a folder's model whose images are these views, by file name and place, and their pairs;
    and notes.

    None where it is another's or cannot be read. The views may stand as in the model, or moved by `applied`
    [3 4], which then moves the points too.
    """
    folder = largest_model(data)[0]
    try:
        model = None if folder is None else read_model(folder)
    except DataError as fault:
        return None, None, [f"points are not read: {fault}"]
    # The same images, by the names of their files, with as many of their folders (those of a rig's cameras)
    # as tell them apart?
    names = [PurePosixPath(view.name).parts for view in views]
    depth = next(n for n in itertools.count(1) if len({name[-n:] for name in names}) == len(names))
    if model:
        images = {PurePosixPath(image.name).parts[-depth:]: image for image in model.images}
    else:
        images = {}
    if model is None or not len(model.points) or not {name[-depth:] for name in names} <= images.keys():
        return None, None, []
    ordered = [images[name[-depth:]] for name in names]
    # Do their cameras stand where the views do, as they are or moved?
    here = np.stack([view.pose[:, 3] for view in views])
    turn = rotations(torch.tensor([image.quaternion for image in ordered], dtype=torch.float64)).numpy()
    offset = np.array([image.translation for image in ordered])
    extent = np.ptp(here, axis=0).max() if len(here) > 1 else 1.0
    for move in (np.eye(3, 4), applied):
        with np.errstate(over="ignore", invalid="ignore"):
            centres = -np.einsum("vji,vj->vi", turn, offset) @ move[:, :3].T + move[:, 3]
            points = model.points @ move[:, :3].T + move[:, 3]
        if np.abs(centres - here).max() <= _MAX_CENTRE_OFFSET * extent:
            return *cloud_of_images(replace(model, points=points), observed_points(model, ordered)), []
    return None, None, []


def read_cloud(path: Path, views: int) -> Cloud:
    """`xyz` and, where there is one, `seen` of a points.npz; points that are not finite are left out."""
    # Points of no finite place are left out, and with them the pairs that name them.
    xyz = read_npz(path, "xyz")
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise DataError(f"{path}: xyz has shape {xyz.shape}, not [P 3]; write it again or remove the file")
    with zipfile.ZipFile(path) as archive:
        if "seen.npy" not in archive.namelist():
            return xyz[np.asarray(np.isfinite(xyz).all(1))], None
    seen = read_npz(path, "seen")
    if seen.ndim != 2 or seen.shape[1] != 2 or not ((seen >= 0) & (seen < (views, len(xyz)))).all():
        raise DataError(
            f"{path}: seen is no [O 2] of {views} views and {len(xyz)} points; write it again or leave it out"
        )
    return _finite(xyz, seen.astype(np.int64))


def _undistort(folder: Path, images: str = "IMAGES") -> str:
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


class _PosedImage(NamedTuple):
    """An image of a model and its file."""

    name: str
    """Path inside the image folder, as a view's."""
    path: Path
    image: ColmapImage
    rows: NDArray[np.int64]
    """Rows of the model's points that it observes."""

    @property
    def file_name(self) -> str:
        """Name without folders, as the model has it."""
        return PurePosixPath(self.image.name).name


class ColmapParser(DataParser):
    """A sparse model and the folder of its images."""

    def __init__(self, config: ColmapConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: float, roles: Mapping[str, str] | None = None) -> ParsedScene:
        """The scene at 1/downscale of the size of the images in the chosen folder.

        Of `roles`, train or test by file name, images without one are left out; else every 8th is for
        testing.
        """
        folder, notes = largest_model(data)
        if folder is None:
            raise DataError(
                f"{data}: no cameras.bin or cameras.txt in sparse/0, sparse or here; run COLMAP's mapper"
            )
        # The model, and the files that its images are.
        model = read_model(folder)
        if not model.images:
            raise DataError(f"{folder}: the model has no images; run COLMAP's mapper again")
        root, said = image_folder(path_inside(data, "parser.images", self.config.images)[1])
        posed = _posed_images(folder, model, root, roles)
        undistort = _undistort(folder, str(root))
        views, kept, lost = read_views(data, posed, lambda each: _view(folder, model, each, undistort))
        # The points, and which of the views that are left see them.
        points, seen = cloud_of_images(model, [each.rows for each in kept])
        beside: list[str] = []
        if not len(points):
            extra, beside = _points_beside(data, folder)
            points = points if extra is None else extra
        split = None
        if roles is not None:
            learned = [roles[each.file_name] == "train" for each in kept]
            split = index_tensor(learned), index_tensor([not each for each in learned])
        contents = CaptureContents(
            views=views,
            split=split,
            points=points,
            seen=seen,
            reduced=root != data / "images",
            notes=(*notes, *said, *lost, *beside),
        )
        return assemble_scene(data, contents, downscale=downscale)


def _posed_images(
    folder: Path, model: ColmapModel, root: Path, roles: Mapping[str, str] | None
) -> list[_PosedImage]:
    """The images of a model in the order of their names. Raises DataError where `roles` name none of them."""
    files = NamedFiles(root)
    posed = []
    for image, rows in zip(model.images, observed_points(model, model.images), strict=True):
        name, path = files.find(f"{folder}: image {image.name!r}", image.name)
        each = _PosedImage(name, path, image, rows)
        if roles is None or each.file_name in roles:
            posed.append(each)
    if not posed:
        raise DataError(
            f"{folder}: the model has none of the images that are asked for; are they another scene's?"
        )
    return sorted(posed, key=lambda each: each.name)


def _points_beside(data: Path, folder: Path) -> tuple[NDArray[np.float64] | None, list[str]]:
    """Points of a PLY file: 3DGS keeps those of a model, or those that it was begun with, beside it."""
    for file in (folder / "points3D.ply", folder / "input.ply", data / "input.ply"):
        if file.is_file():
            return read_ply_points(file)
    return None, []


def _view(folder: Path, model: ColmapModel, posed: _PosedImage, undistort: str) -> View:
    """A view of a model; `undistort` is the remedy for a lens that cannot be represented."""
    where = f"{folder}: image {posed.image.name!r}"
    camera = model.cameras.get(posed.image.camera)
    if camera is None:
        raise DataError(
            f"{where}: its camera {posed.image.camera} is not in the model; export the model again"
        )
    # World to camera in OpenCV's axes becomes camera to world in OpenGL's: y and z turn round.
    back = quaternion_rotation(where, posed.image.quaternion).T
    # A damaged translation may overflow; `rigid_pose` leaves out what is not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        centre = -back @ np.array(posed.image.translation)
    pose = rigid_pose(where, np.stack([back[:, 0], -back[:, 1], -back[:, 2], centre], 1))
    own = f"{folder}: camera {posed.image.camera}"
    size = pixel_size(own, camera.width, camera.height)
    # Parameters by name; what is left after those that every lens has are terms that few have.
    given = dict(zip(dict(MODELS)[camera.model].split(), camera.params, strict=True))
    focal = given.pop("f", 0.0)
    k = []
    for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
        k.append(given.pop(key, 0.0))
    fx = given.pop("fx", focal)
    fy = given.pop("fy", focal)
    cx = given.pop("cx", 0.0)
    cy = given.pop("cy", 0.0)
    distortion, lens = lens_of(own, camera.model, k, list(given.values()), undistort)
    return View(
        name=posed.name,
        path=posed.path,
        pose=pose,
        size=size,
        focal=(fx, fy),
        centre=(cx, cy),
        distortion=distortion,
        lens=lens,
        depths=_depths(model.points[posed.rows], pose),
    )


def _depths(points: NDArray[np.float64], pose: NDArray[np.float64]) -> tuple[float, float] | None:
    """Bounds of the depths of the points that an image observes; None where they are too few for a
    percentile.
    """
    # Damaged coordinates may overflow; what is not finite is left out.
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (points - pose[:, 3]) @ -pose[:, 2]
    depth = depth[np.isfinite(depth) & (depth > 0)]
    if len(depth) < _MIN_DEPTHS:
        return None
    near, far = np.percentile(depth, _DEPTH_PERCENTILES)
    return (float(near), float(far)) if 0 < near < far else None
