"""COLMAP sparse models to scenes.

COLMAP's lenses become ours; its world-to-camera poses in OpenCV axes become camera-to-world in OpenGL's. The
world frame is kept. Each view's depths are the 0.1 and 99.9 percentile of the points that it observes (LLFF's
rule).
"""

import itertools
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from .colmap_model import MODELS, ColmapImage, ColmapModel, largest_model, read_model, undistort_remedy
from .config import ColmapConfig
from .files import NamedFiles, image_folder, path_inside, read_npz, read_ply_points
from .views import View, lens_of, pixel_size, quaternion_rotation, read_views, rigid_pose

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
        undistort = undistort_remedy(folder, str(root))
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
