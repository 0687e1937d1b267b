"""`transforms.json` of Nerfstudio and instant-ngp, and Blender's `transforms_train.json` / `transforms_test.json`.

Poses are camera-to-world in OpenGL axes and are kept as they are (an `applied_transform` is not undone). Intrinsics
(`fl_x fl_y cx cy w h`, else `camera_angle_x`; `k1 k2 k3 k4 p1 p2`; `camera_model`; `near`, `far`) stand once or by frame.
`mask_path` names an image's mask (black pixels are left out), `sky_mask_path` one of its sky (white).
`points.npz` beside the file holds sparse points in the same frame; so does a COLMAP model in `sparse/0` that it was made of.
"""

import math
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...errors import DataError
from ...interfaces import DataParser
from ...rendering.lens import FISHEYE, OPENCV, PINHOLE
from ..images import read_header
from ..scene import Scene
from .colmap import cloud_of_model, read_cloud
from .config import TransformsConfig
from .files import Record, as_record, path_inside, read_json
from .views import View, assemble_scene, check_images_exist, index_tensor, pixel_size, rigid_pose

_LENSES = {
    "PINHOLE": PINHOLE,
    "SIMPLE_PINHOLE": PINHOLE,
    "OPENCV": OPENCV,
    "SIMPLE_RADIAL": OPENCV,
    "RADIAL": OPENCV,
    "OPENCV_FISHEYE": FISHEYE,
}
_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Tried in this order for Blender's paths, which have none."""


class _Entry(NamedTuple):
    """A frame before its image is looked at."""

    record: Record
    name: str
    path: Path
    role: str
    """train, test, or nothing: then the file's lists or the rule decide."""
    data: Path
    """Folder that paths are relative to."""


class TransformsParser(DataParser):
    """One JSON file with all frames, or Blender's pair."""

    def __init__(self, config: TransformsConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene at 1/downscale of the size that the file's intrinsics belong to."""
        files = self._files(data)
        tops = [as_record(file, read_json(file)) for file, _ in files]
        entries = []
        for top, (_, role) in zip(tops, files, strict=True):
            entries += [_entry(data, record, role) for record in top.records("frames")]
        entries.sort(key=lambda entry: entry.name)
        for first, second in pairwise(entries):
            if first.name == second.name:
                raise DataError(f"{second.record.where}: the image {second.name} occurs twice; remove one of the frames")
        check_images_exist(data, [entry.path for entry in entries])
        views = [_view(entry) for entry in entries]
        points, seen = _cloud(data, views)
        return assemble_scene(data, views, downscale=downscale, split=_split(data, tops, entries), points=points, seen=seen)

    def _files(self, data: Path) -> list[tuple[Path, str]]:
        if self.config.file:
            return [(path_inside(data, "parser.file", self.config.file)[1], "")]
        single = data / "transforms.json"
        train, test = data / "transforms_train.json", data / "transforms_test.json"
        if single.is_file():
            return [(single, "")]
        if train.is_file():
            return [(train, "train"), (test, "test")] if test.is_file() else [(train, "")]
        others = list(data.glob("transforms*.json"))
        if len(others) == 1:
            return [(others[0], "")]
        raise DataError(f"{data}: neither transforms.json nor transforms_train.json; name the file with parser.file")


def _cloud(data: Path, views: list[View]) -> tuple[NDArray[np.float64] | None, NDArray[np.int64] | None]:
    """Sparse points, and which views see them: of points.npz, or of the COLMAP model that the transforms came from."""
    cloud, model = data / "points.npz", data / "sparse" / "0"
    points, seen = read_cloud(cloud, len(views)) if cloud.is_file() else (None, None)
    if seen is None and ((model / "cameras.bin").is_file() or (model / "cameras.txt").is_file()):
        sparse = cloud_of_model(model, [view.name for view in views], [view.pose for view in views])
        return (points, None) if sparse is None else sparse
    return points, seen


def _entry(data: Path, record: Record, role: str) -> _Entry:
    text = record.text("file_path")
    if text is None:
        raise DataError(f"{record.where}: file_path is missing; each frame names its image")
    name, path = path_inside(data, record.where, text)
    if not path.is_file():
        for suffix in _SUFFIXES:
            if path.with_name(path.name + suffix).is_file():
                return _Entry(record, name + suffix, path.with_name(path.name + suffix), role, data)
    return _Entry(record, name, path, role, data)


def _view(entry: _Entry) -> View:
    record = entry.record
    header = read_header(entry.path)
    width, height = record.number("w"), record.number("h")
    size = pixel_size(record.where, header.width if width is None else width, header.height if height is None else height)
    near, far = record.number("near"), record.number("far")
    cx, cy = record.number("cx"), record.number("cy")
    distortion, lens = _lens(record)
    return View(
        name=entry.name,
        path=entry.path,
        pose=rigid_pose(f"{record.where} ({entry.name})", record.matrix("transform_matrix")),
        size=size,
        focal=_focal(record, size),
        centre=(size[0] / 2 if cx is None else cx, size[1] / 2 if cy is None else cy),
        distortion=distortion,
        lens=lens,
        depths=None if near is None or far is None else (near, far),
        mask=_named(entry, "mask_path"),
        sky_mask=_named(entry, "sky_mask_path"),
    )


def _named(entry: _Entry, key: str) -> Path | None:
    text = entry.record.own.get(key)
    if text is None:
        return None
    return path_inside(entry.data, entry.record.where, entry.record.text(key) or "")[1]


def _focal(record: Record, size: tuple[int, int]) -> tuple[float, float]:
    def one(key: str, angle_key: str, pixels: int) -> float | None:
        focal, angle = record.number(key), record.number(angle_key)
        if focal is not None or angle is None:
            return focal
        if not 0 < angle < math.pi:
            raise DataError(f"{record.where}: {angle_key} is {angle}; it must lie between 0 and pi")
        return pixels / 2 / math.tan(angle / 2)

    fx, fy = one("fl_x", "camera_angle_x", size[0]), one("fl_y", "camera_angle_y", size[1])
    first = fy if fx is None else fx
    if first is None:
        raise DataError(f"{record.where}: neither fl_x nor camera_angle_x; give the focal length in pixels as fl_x")
    return first, first if fy is None else fy


def _lens(record: Record) -> tuple[tuple[float, float, float, float, float, float], int]:
    k1, k2, k3, k4, p1, p2 = (record.number(key) or 0.0 for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = record.text("camera_model")
    if model is None:
        model = "OPENCV_FISHEYE" if record.get("is_fisheye") is True else "OPENCV"
    if model not in _LENSES:
        raise DataError(f"{record.where}: camera_model {model!r} is not supported; undistort to one of {list(_LENSES)}")
    lens = _LENSES[model]
    if lens == FISHEYE and (p1 or p2):
        raise DataError(f"{record.where}: a fisheye with tangential p1, p2 is not supported; undistort the images")
    distorted = any((k1, k2, k3, k4, p1, p2))
    if lens == PINHOLE and distorted:
        raise DataError(f"{record.where}: camera_model {model} with distortion k or p; use OPENCV or remove them")
    return (k1, k2, k3, k4, p1, p2), OPENCV if lens == OPENCV and distorted else FISHEYE if lens == FISHEYE else PINHOLE


def _split(data: Path, tops: list[Record], entries: list[_Entry]) -> tuple[Tensor, Tensor] | None:
    """Blender's two files, or the lists of file names of the one; None: the rule decides."""
    if len(tops) > 1:
        return index_tensor([e.role == "train" for e in entries]), index_tensor([e.role == "test" for e in entries])
    top = tops[0]
    train, test = top.texts("train_filenames"), top.texts("test_filenames")
    if train is None and test is None:
        return None
    names = {entry.name for entry in entries}
    listed = []
    for key, texts in (("train_filenames", train), ("test_filenames", test)):
        members = {path_inside(data, f"{top.where}: {key}", text)[0] for text in texts or ()}
        if not members <= names:
            raise DataError(f"{top.where}: {key} has {min(members - names)!r}, which no frame is; remove it there")
        listed.append(members)
    both = listed[0] & listed[1]
    if both:
        raise DataError(f"{top.where}: {min(both)!r} is in train_filenames and in test_filenames; remove it from one")
    learned = names - listed[1] if train is None else listed[0]
    held = names - listed[0] - set(top.texts("val_filenames") or ()) if test is None else listed[1]
    return index_tensor([e.name in learned for e in entries]), index_tensor([e.name in held for e in entries])
