"""OpenDroneMap's projects (ODM, WebODM): images with `opensfm/reconstruction.json`, or
`odm_report/shots.geojson` with `cameras.json` where a download holds no more than those.

OpenSfM's coordinates on the image plane have their origin in the middle and the larger side as their unit, so
they hold for images of any size. A shot's `rotation` (axis times angle) and, in a reconstruction,
`translation` take the world to the camera, whose x is right, y down and z forward. In shots.geojson
`translation` is the camera's place in projected metres. Frames are kept: x points east and y north, to two
degrees, in a report and in a reconstruction whose `reference_lla` says where on the earth its origin lies. Of several
reconstructions that of most shots is read. WebODM's download leaves the photographs out: put them in `images`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ...rendering.north import North
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene
from .config import ODM_FILES, OdmConfig, project_file
from .files import NamedFiles, Record, as_record, image_folder, path_inside, read_json
from .views import View, image_size, lens_of, read_views, rigid_pose

_COLMAP_MODELS = dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), "OPENCV")
_COLMAP_MODELS |= {"fisheye": "FISHEYE", "fisheye_opencv": "OPENCV_FISHEYE", "spherical": "EQUIRECTANGULAR"}
"""COLMAP's names of OpenSfM's lenses."""
_OPENCV_TO_OPENGL = np.array([1.0, -1.0, -1.0])
"""Factors of a camera's axes: y and z turn round."""
_MAX_ANGLE = 1e3
"""Radians of a rotation that are taken for one: by eye."""


class _Shot(NamedTuple):
    """An image's pose before the image is looked at."""

    name: str
    camera: Record
    turn: NDArray[np.float64]
    """World to camera, OpenCV's axes."""
    place: NDArray[np.float64]


class OdmParser(DataParser):
    """A project folder."""

    def __init__(self, config: OdmConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of its photographs, with the reconstruction's points where they are
        there.
        """
        file = project_file(data)
        if file is None:
            raise DataError(f"{data}: neither {' nor '.join(ODM_FILES)}; give the folder of an ODM project")
        # A whole project brings points; a report has poses alone.
        points = None
        north: North | None = _north("the shots of an ODM report are in projected metres", None)
        if file.name == "reconstruction.json":
            shots, points, north = _reconstruction(file)
        else:
            shots = _shots(data, file)
        folder, said = image_folder(path_inside(data, "parser.images", self.config.images)[1])
        files = NamedFiles(folder)
        named = sorted(
            ((*files.find(str(file), shot.name), shot) for shot in shots), key=lambda each: each[0]
        )
        views, _, lost = read_views(data, named, lambda each: _view(str(file), *each))
        # A world that is placed on the earth has z up.
        up = None if north is None else (0.0, 0.0, 1.0)
        contents = CaptureContents(views=views, points=points, up=up, north=north, notes=(*said, *lost))
        return assemble_scene(data, contents, downscale=downscale)


def _north(says: str, latitude: float | None) -> North:
    southern = None if latitude is None else latitude < 0
    return North(direction=(0.0, 1.0, 0.0), source=f"+y, as {says}", southern=southern)


def _reconstruction(file: Path) -> tuple[list[_Shot], NDArray[np.float64], North | None]:
    """Shots, points and north of the largest part."""
    whole = read_json(file)
    parts = []
    if isinstance(whole, list):
        parts = [as_record(f"{file}: [{k}]", part) for k, part in enumerate(whole)]
    largest = max(parts, key=lambda part: len(_objects(part, "shots")), default=None)
    if largest is None or not _objects(largest, "shots"):
        raise DataError(f"{file}: no list of reconstructions with shots; run ODM again")
    cameras = _objects(largest, "cameras")
    # A shot's place is -R^T t, of the rotation and the translation that take the world to the camera.
    shots = []
    for name, record in _objects(largest, "shots").items():
        key = record.text("camera") or ""
        if key not in cameras:
            raise DataError(f"{record.where}: its camera {key!r} is none of cameras; run ODM again")
        turn = _turn(record)
        offset = record.numbers("translation", 3)
        shots.append(_Shot(name, cameras[key], turn, -turn.T @ offset))
    points = []
    for point in _objects(largest, "points").values():
        points.append(point.numbers("coordinates", 3))
    cloud = np.array(points).reshape(-1, 3)
    return shots, cloud[np.isfinite(cloud).all(1)], _north_of(largest)


def _north_of(part: Record) -> North | None:
    """North of a reconstruction, whose reference is 0 where no photograph had a position."""
    if part.get("reference_lla") is None:
        return None
    reference = as_record(f"{part.where}: reference_lla", part.get("reference_lla"))
    latitude = reference.number("latitude") or 0.0
    longitude = reference.number("longitude") or 0.0
    if not (abs(latitude) < 90 and abs(longitude) <= 180) or (latitude == 0 and longitude == 0):
        return None
    return _north("its reference_lla says", latitude)


def _shots(data: Path, file: Path) -> list[_Shot]:
    """Shots of a report, with the cameras beside it."""
    # cameras.json is an object of cameras; the report one of features with properties.
    beside = data / "cameras.json"
    cameras = _objects(as_record(beside, {"cameras": read_json(beside)}), "cameras")
    shots = []
    for feature in as_record(file, read_json(file)).records("features"):
        record = as_record(f"{feature.where}: properties", feature.own.get("properties"))
        name = record.text("filename")
        key = record.text("camera")
        if name is None:
            raise DataError(f"{record.where}: filename is missing; each shot names its image")
        if key is None and len(cameras) == 1:
            key = next(iter(cameras))
        if key is None or key not in cameras:
            raise DataError(
                f"{record.where}: which of {len(cameras)} cameras took it is not said; keep {ODM_FILES[0]}"
            )
        shots.append(_Shot(name, cameras[key], _turn(record), record.numbers("translation", 3)))
    return shots


def _view(where: str, name: str, path: Path, shot: _Shot) -> View:
    width, height = image_size(path)
    camera = shot.camera
    longest = max(width, height)
    # Another size is fine, another shape means that the photographs were cropped or turned.
    wide = camera.number("width")
    tall = camera.number("height")
    if wide is not None and tall is not None and abs(wide * height - tall * width) > wide + tall:
        raise DataError(f"{path}: {width}x{height} pixels is not the shape of its camera; restore the image")
    # The lens, and the focal lengths in pixels: OpenSfM's unit is the longer side.
    kind = camera.text("projection_type") or "perspective"
    if kind not in _COLMAP_MODELS:
        raise DataError(
            f"{camera.where}: projection_type {kind!r} is not read; known are {', '.join(_COLMAP_MODELS)}"
        )
    k = []
    for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
        k.append(camera.number(key) or 0.0)
    distortion, lens = lens_of(camera.where, _COLMAP_MODELS[kind], k)
    fx = camera.number("focal_x") or camera.number("focal")
    fy = camera.number("focal_y") or camera.number("focal")
    if fx is None:
        raise DataError(f"{camera.where}: neither focal nor focal_x; run ODM again")
    turned = np.concatenate([shot.turn.T * _OPENCV_TO_OPENGL, shot.place[:, None]], 1)
    return View(
        name=name,
        path=path,
        pose=rigid_pose(f"{where} ({name})", turned),
        size=(width, height),
        focal=(fx * longest, (fx if fy is None else fy) * longest),
        # OpenSfM counts pixels from the middle of the first one, we from its corner: the half cancels.
        centre=(
            width / 2 + (camera.number("c_x") or 0) * longest,
            height / 2 + (camera.number("c_y") or 0) * longest,
        ),
        distortion=distortion,
        lens=lens,
    )


def _turn(record: Record) -> NDArray[np.float64]:
    vector = record.numbers("rotation", 3)
    if np.abs(vector).max() > _MAX_ANGLE:
        raise DataError(
            f"{record.where}: rotation is {vector.tolist()}, not an axis times an angle; run ODM again"
        )
    return np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)


def _objects(record: Record, key: str) -> Mapping[str, Record]:
    """An object of objects by their names; none where it is absent."""
    value = record.own.get(key)
    if value is None:
        return {}
    whole = as_record(f"{record.where}: {key}", value)
    found = {}
    for name, each in whole.own.items():
        found[name] = as_record(f"{whole.where}[{name!r}]", each)
    return found
