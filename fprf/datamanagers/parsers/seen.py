"""Which views a reconstruction found each of its points in: pairs (view, point).

A COLMAP model says so itself. A `transforms.json` may lie beside the model it came from; the model is believed where its
cameras stand where the transforms say. `points.npz` may hold the pairs as `seen` [O 2]: view in the order of names, point.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from .colmap_model import ColmapImage, ColmapModel, read_model
from .files import read_npz

__all__ = ["Cloud", "beside", "pairs", "read_cloud"]

_APART = 1e-3
"""Share of the cameras' extent by which the two sets of camera centres may differ."""

Cloud = tuple[NDArray[np.float64], NDArray[np.int64] | None]
"""Finite points [P 3], and pairs [O 2] where known."""


def pairs(model: ColmapModel, images: Sequence[ColmapImage]) -> Cloud:
    """Finite points of a model, and the pairs of its images in the order given."""
    finite = np.isfinite(model.points).all(1)
    ids = model.point_ids[finite]
    order = np.argsort(ids, kind="stable")
    found = []
    for view, image in enumerate(images):
        at = np.searchsorted(ids, image.observed, sorter=order)
        inside = at < len(ids)
        point = order[at[inside]]
        point = np.unique(point[ids[point] == image.observed[inside]])
        found.append(np.stack([np.full(len(point), view), point], 1))
    return model.points[finite], np.concatenate(found).astype(np.int64) if found else np.zeros((0, 2), np.int64)


def beside(folder: Path, names: Sequence[str], poses: Sequence[NDArray[np.float64]]) -> Cloud | None:
    """The points of a model whose images are these views, by file name and place; None where it is another's."""
    model = read_model(folder)
    images = {PurePosixPath(image.name).name: image for image in model.images}
    files = [PurePosixPath(name).name for name in names]
    if not len(model.points) or len(set(files)) < len(files) or not set(files) <= images.keys():
        return None
    ordered = [images[file] for file in files]
    here = np.stack([pose[:, 3] for pose in poses])
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.abs(np.stack([_centre(image) for image in ordered]) - here).max()
    extent = np.ptp(here, axis=0).max() if len(here) > 1 else 1.0
    return pairs(model, ordered) if apart <= _APART * extent else None


def read_cloud(path: Path, views: int) -> Cloud:
    """`xyz` and, where there is one, `seen` of a points.npz; points that are not finite are left out."""
    xyz = read_npz(path, "xyz")
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise DataError(f"{path}: xyz has shape {xyz.shape}, not [P 3]; write it again or remove the file")
    finite = np.asarray(np.isfinite(xyz).all(1))
    with zipfile.ZipFile(path) as archive:
        if "seen.npy" not in archive.namelist():
            return xyz[finite], None
    seen = read_npz(path, "seen")
    if seen.ndim != 2 or seen.shape[1] != 2 or not ((seen >= 0) & (seen < (views, len(xyz)))).all():
        raise DataError(f"{path}: seen is no [O 2] of {views} views and {len(xyz)} points; write it again or leave it out")
    kept = seen.astype(np.int64)
    kept = kept[finite[kept[:, 1]]]
    kept[:, 1] = (np.cumsum(finite) - 1)[kept[:, 1]]
    return xyz[finite], kept


def _centre(image: ColmapImage) -> NDArray[np.float64]:
    w, x, y, z = np.array(image.quaternion) / max(1e-9, float(np.linalg.norm(image.quaternion)))
    axis, t = np.array([x, y, z]), np.array(image.translation)
    # The inverse rotation of -t: quaternions turn a vector by two cross products.
    twice = 2 * np.cross(-axis, -t)
    return np.asarray(-t + w * twice + np.cross(-axis, twice))
