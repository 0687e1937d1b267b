"""`transforms.json` of Nerfstudio and instant-ngp, and Blender's `transforms_train.json` /
`transforms_test.json`.

Poses are camera-to-world in OpenGL axes and are kept as they are (an `applied_transform` is not undone).
Intrinsics (`fl_x fl_y cx cy w h`, else `camera_angle_x`; `distortion_params`, else `k1 k2 k3 k4 p1 p2`;
`camera_model`; `near`, `far`) stand once or by frame. `mask_path` names an image's mask (black pixels are
left out), `sky_mask_path` one of its sky (white). `points.npz` beside the file or the PLY file that
`ply_file_path` names hold sparse points in the same frame; so does the COLMAP model, in `sparse/0` or
elsewhere, that it was made of, whose points are moved by `applied_transform`.
"""

import math
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...errors import DataError
from ...interfaces import DataParser
from ..images import IMAGE_SUFFIXES
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene, index_tensor
from .colmap import cloud_of_model, read_cloud
from .config import TransformsConfig
from .files import NamedFiles, Record, as_record, path_inside, read_json, read_ply_points
from .views import UNDISTORT, View, lens_of, read_views, rigid_pose, stated_size

_CAMERA_MODELS = frozenset(
    {"PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "EQUIRECTANGULAR"}
    | {"OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
)
_APPLIED = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]])
"""The transform that ns-process-data applied before it wrote `applied_transform`."""


class _Entry(NamedTuple):
    """A frame before its image is looked at."""

    record: Record
    name: str
    path: Path
    role: str
    """train, test, or nothing: then the file's lists or the rule decide."""


def _frames(top: Record, inside: NamedFiles, role: str) -> list[_Entry]:
    """The frames of one file, with their images."""
    entries = []
    for record in top.records("frames"):
        text = record.text("file_path")
        if text is None:
            raise DataError(f"{record.where}: file_path is missing; each frame names its image")
        name, path = inside.find(record.where, text, IMAGE_SUFFIXES)
        entries.append(_Entry(record, name, path, role))
    return entries


class TransformsParser(DataParser):
    """One JSON file with all frames, or Blender's pair."""

    def __init__(self, config: TransformsConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of the size of its images."""
        files = self._files(data)
        tops = []
        for file, _ in files:
            tops.append(as_record(file, read_json(file)))
        inside = NamedFiles(data)
        entries = []
        for top, (_, role) in zip(tops, files, strict=True):
            entries += _frames(top, inside, role)
        entries.sort(key=lambda entry: entry.name)
        # A frame that is written twice over says nothing new; where the two differ `read_views` refuses them.
        once: list[_Entry] = []
        for entry in entries:
            if not once or once[-1].record.own != entry.record.own:
                once.append(entry)
        views, kept, notes = read_views(data, once, lambda entry: _view(entry, inside))
        if len(once) < len(entries):
            notes.append(f"frames that are written twice are read once: {len(entries) - len(once)}")
        if tops[0].get("fisheye_crop_radius") is not None:
            notes.append(
                "fisheye_crop_radius is not applied: leave out what lies outside of the circle with masks/"
            )
        points, seen, said = _cloud(inside, tops[0], once, views)
        contents = CaptureContents(
            views=views,
            split=_split(inside, tops, once, kept),
            points=points,
            seen=seen,
            reduced=bool(inside.notes),
            notes=(*inside.notes, *notes, *said),
        )
        return assemble_scene(data, contents, downscale=downscale)

    def _files(self, data: Path) -> list[tuple[Path, str]]:
        if self.config.file:
            return [(path_inside(data, "parser.file", self.config.file)[1], "")]
        # Nerfstudio's file before Blender's pair, and any other name only where there is no doubt.
        single = data / "transforms.json"
        train = data / "transforms_train.json"
        test = data / "transforms_test.json"
        if single.is_file():
            return [(single, "")]
        if train.is_file():
            if test.is_file():
                return [(train, "train"), (test, "test")]
            return [(train, "")]
        others = list(data.glob("transforms*.json"))
        if len(others) == 1:
            return [(others[0], "")]
        raise DataError(
            f"{data}: neither transforms.json nor transforms_train.json; name the file with parser.file"
        )


class GardenParser(DataParser):
    """Reads the scene that ships with the package, whatever folder is named."""

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        return TransformsParser(TransformsConfig()).parse(
            Path(str(resources.files("fprf") / "garden")), downscale
        )


def _cloud(
    inside: NamedFiles, top: Record, entries: list[_Entry], views: list[View]
) -> tuple[NDArray[np.float64] | None, NDArray[np.int64] | None, list[str]]:
    """Sparse points, which views see them, and notes.

    The points are those of points.npz, of `ply_file_path`, or of the COLMAP model that the transforms came
    from.
    """
    cloud = inside.root / "points.npz"
    ply = top.text("ply_file_path")
    points = None
    notes: list[str] = []
    if cloud.is_file():
        points, seen = read_cloud(cloud, len(entries))
        if seen is not None:
            return points, _seen_by(views, entries, seen), []
    elif ply:
        points, notes = read_ply_points(inside.find(f"{top.where}: ply_file_path", ply)[1])
    # A model also says which views see its points.
    if top.get("applied_transform") is None:
        applied = _APPLIED
    else:
        applied = top.matrix("applied_transform")[:3]
    sparse, seen, said = cloud_of_model(inside.root, views, applied)
    if sparse is None:
        return points, None, notes + said
    return sparse, seen, []


def _seen_by(views: list[View], entries: list[_Entry], seen: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs of a view and a point, of pairs that count the frames, some of which may be left out."""
    place = {}
    for k, view in enumerate(views):
        place[view.name] = k
    parts = []
    for entry in entries:
        parts.append(place.get(entry.name, -1))
    row = np.array(parts)
    pairs = np.stack([row[seen[:, 0]], seen[:, 1]], 1)
    return pairs[pairs[:, 0] >= 0]


def _view(entry: _Entry, inside: NamedFiles) -> View:
    record = entry.record
    # Without a size the intrinsics belong to the image as it is named, and the principal point is its middle.
    factor = inside.factor(entry.path)
    size = stated_size(record.where, entry.path, record.number("w"), record.number("h"), factor)
    near = record.number("near")
    far = record.number("far")
    cx = _or_half(record.number("cx"), size[0])
    cy = _or_half(record.number("cy"), size[1])
    distortion, lens = _lens(record)
    return View(
        name=entry.name,
        path=entry.path,
        pose=rigid_pose(f"{record.where} ({entry.name})", record.matrix("transform_matrix")),
        size=size,
        focal=_focal(record, size),
        centre=(cx, cy),
        distortion=distortion,
        lens=lens,
        depths=None if near is None or far is None else (near, far),
        mask=_named(entry, inside, "mask_path"),
        sky_mask=_named(entry, inside, "sky_mask_path"),
    )


def _or_half(value: float | None, pixels: int) -> float:
    return pixels / 2 if value is None else value


def _named(entry: _Entry, inside: NamedFiles, key: str) -> Path | None:
    if entry.record.own.get(key) is None:
        return None
    return inside.find(entry.record.where, entry.record.text(key) or "")[1]


def _focal(record: Record, size: tuple[int, int]) -> tuple[float, float]:
    # Either one serves for both.
    fx = _focal_along(record, "fl_x", "camera_angle_x", size[0])
    fy = _focal_along(record, "fl_y", "camera_angle_y", size[1])
    first = fy if fx is None else fx
    if first is None:
        raise DataError(
            f"{record.where}: neither fl_x nor camera_angle_x; give the focal length in pixels as fl_x"
        )
    return first, first if fy is None else fy


def _focal_along(record: Record, key: str, angle_key: str, pixels: int) -> float | None:
    """Focal length along one side, in pixels, as it is given or by the angle of view; None without either."""
    focal = record.number(key)
    angle = record.number(angle_key)
    if focal is not None or angle is None:
        return focal
    if math.isnan(angle):
        return angle
    if not 0 < angle < math.pi:
        raise DataError(f"{record.where}: {angle_key} is {angle}; it must lie between 0 and pi")
    return pixels / 2 / math.tan(angle / 2)


def _lens(record: Record) -> tuple[tuple[float, float, float, float, float, float], int]:
    # Nerfstudio's list in this order counts before single terms.
    # Terms beyond six are those of lenses that cannot be represented: `lens_of` refuses them unless they are
    # 0.
    k = []
    for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
        k.append(record.number(key) or 0.0)
    if record.get("distortion_params") is not None:
        k = record.numbers("distortion_params", 6).tolist()
    others = []
    for key in ("k5", "k6"):
        others.append(record.number(key) or 0.0)
    model = record.text("camera_model")
    if model is None:
        if record.get("is_fisheye") is True:
            model = "OPENCV_FISHEYE"
        else:
            model = "OPENCV"
    if model not in _CAMERA_MODELS:
        raise DataError(
            f"{record.where}: camera_model {model!r} is none of {', '.join(sorted(_CAMERA_MODELS))}; {UNDISTORT}"
        )
    if model == "FULL_OPENCV":  # whose k4 is a denominator's; nerfstudio's OPENCV has a polynomial of four
        others = [k[3], *others]
        k[3] = 0.0
    return lens_of(record.where, model, k, others)


def _split(
    inside: NamedFiles, tops: list[Record], entries: list[_Entry], kept: list[_Entry]
) -> tuple[Tensor, Tensor] | None:
    """Blender's two files, or the lists of file names of the one, among those kept; None: the rule
    decides.
    """
    if len(tops) > 1:
        return index_tensor([e.role == "train" for e in kept]), index_tensor([e.role == "test" for e in kept])
    top = tops[0]
    train = top.texts("train_filenames")
    test = top.texts("test_filenames")
    if train is None and test is None:
        return None
    # What is listed must be there, and on one side.
    names = set()
    for entry in entries:
        names.add(entry.name)
    learned = _listed(inside, top, "train_filenames")
    held = _listed(inside, top, "test_filenames")
    for key, members in (("train_filenames", learned), ("test_filenames", held)):
        if not members <= names:
            raise DataError(
                f"{top.where}: {key} has {min(members - names)!r}, which no frame is; remove it there"
            )
    both = learned & held
    if both:
        raise DataError(
            f"{top.where}: {min(both)!r} is in train_filenames and in test_filenames; remove it from one"
        )
    # A side without a list has the rest; where nothing is left for testing, the views for validation serve.
    if test is None:
        val = _listed(inside, top, "val_filenames") - learned
        held = names - learned - val or val
    if train is None:
        learned = names - _listed(inside, top, "test_filenames")
    return index_tensor([e.name in learned for e in kept]), index_tensor([e.name in held for e in kept])


def _listed(inside: NamedFiles, top: Record, key: str) -> set[str]:
    """Names of the frames in a list of file names; none where there is no list."""
    members = set()
    for text in top.texts(key) or ():
        members.add(inside.find(f"{top.where}: {key}", text, IMAGE_SUFFIXES)[0])
    return members
