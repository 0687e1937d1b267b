"""Views of a capture, checked: poses, sizes, lenses, and that images are there.

`assembly` makes a scene of views.
"""

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...rendering.lens import FISHEYE, OPENCV, PINHOLE
from ...rendering.splines import rotations
from ..images import read_header

_MAX_SKEW = 1e-3
"""Largest deviation of RᵀR from 1 that counts as rounding and is repaired."""
_MAX_COORDINATE = 1e12
"""Largest coordinate of a camera: beyond it float64 has no millimetres left."""
_MAX_INTRINSIC = 1e9
"""Largest number of a lens, in pixels: no camera's, and its products stay within float64 (by eye)."""
_MAX_SIDE = 10**6
"""Largest side of an image in pixels that is believed: by eye."""
_MAX_LENGTH_ERROR = 0.1
"""Deviation from 1 of a quaternion's length that text of two digits may have: by eye."""


@dataclass(frozen=True, kw_only=True)
class View:
    """One image and its camera, as the capture gives them."""

    name: str
    """Path inside the image folder, with slashes: what views are sorted by."""
    path: Path
    pose: NDArray[np.float64]
    """Camera to world [3 4], OpenGL axes."""
    size: tuple[int, int]
    """Width and height that the intrinsics belong to."""
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    lens: int = 0
    depths: tuple[float, float] | None = None
    mask: Path | None = None
    """File that the capture names; else one beside the image."""
    sky_mask: Path | None = None
    exposure: float | None = None
    """Exposure, where the capture says it: light is in proportion to it. Above 0."""


class UnusableView(DataError):
    """A view that is left out because its numbers are not finite; the others are read."""

    def __init__(self, where: str) -> None:
        self.where = where
        super().__init__(f"{where}: numbers of its camera are not finite; run the reconstruction again")


class _MissingImage(DataError):
    """An image that is not there: all that are missing are told at once."""


Entry = TypeVar("Entry")


def read_views(
    data: Path, entries: Iterable[Entry], view: Callable[[Entry], View]
) -> tuple[list[View], list[Entry], list[str]]:
    """The views of a capture's entries, the entries that they are of, and notes on those left out (see
    `UnusableView`).

    Raises DataError where images are missing, where one occurs twice, and where nothing is left.
    """
    views: dict[str, View] = {}
    kept: list[Entry] = []
    lost: list[str] = []
    missing: list[str] = []
    for entry in entries:
        try:
            one = view(entry)
            if not np.isfinite((*_intrinsics(one), *(one.depths or ()))).all():
                raise UnusableView(str(one.path))
            if not os.path.isfile(one.path):
                raise _MissingImage(str(one.path))
        except UnusableView as fault:
            lost.append(fault.where)
            continue
        except _MissingImage as fault:
            missing.append(str(fault))
            continue
        _check_numbers(one)
        if one.name in views:
            raise DataError(f"{data}: the image {one.name} occurs twice; remove one of its cameras")
        views[one.name] = one
        kept.append(entry)
    # A reconstruction may fail for single images, but a missing one is mostly a folder that was copied in
    # part.
    count = len(views) + len(lost) + len(missing)
    if missing:
        raise DataError(
            f"{data}: {len(missing)} of {count} images are missing, the first is {missing[0]}; "
            "copy them there or remove their entries"
        )
    notes = []
    if lost:
        notes.append(f"{len(lost)} of {count} images are left out, whose camera is not finite: {lost[0]}")
    if not views:
        raise DataError(f"{data}: no view is left: {'; '.join(notes)}; run the reconstruction again")
    return list(views.values()), kept, notes


def _intrinsics(view: View) -> tuple[float, ...]:
    return (*view.focal, *view.centre, *view.distortion)


def _check_numbers(view: View) -> None:
    """Raise DataError where finite numbers are no camera's: nothing that would follow from it is worth having."""
    numbers = _intrinsics(view)
    if max(map(abs, numbers)) > _MAX_INTRINSIC:
        raise DataError(
            f"{view.path}: the camera's numbers {numbers} go beyond {_MAX_INTRINSIC:g}; calibrate again"
        )
    if min(view.focal) <= 0:
        raise DataError(
            f"{view.path}: the focal length is {min(view.focal)}, it must be above 0; calibrate again"
        )
    if view.depths is not None and not 0 < view.depths[0] < view.depths[1]:
        raise DataError(
            f"{view.path}: nearest and farthest depth are {view.depths[0]} and {view.depths[1]}, "
            "0 < near < far is needed; remove or correct them"
        )


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image. Raises DataError where it is missing or cannot be read."""
    if not os.path.isfile(path):
        raise _MissingImage(str(path))
    header = read_header(path)
    return header.width, header.height


def pixel_size(where: str, width: float, height: float) -> tuple[int, int]:
    """Width and height as whole numbers. Raises DataError, opened by `where`, unless both lie in 1 to 1e6."""
    if not math.isfinite(width + height):
        raise UnusableView(where)
    size = round(float(width)), round(float(height))
    if min(size) < 1 or max(size) > _MAX_SIDE:
        raise DataError(
            f"{where}: {width:g}x{height:g} pixels; a side has 1 to {_MAX_SIDE}: correct it, or export it again"
        )
    return size


def stated_size(
    where: str, path: Path, width: float | None, height: float | None, factor: int = 1
) -> tuple[int, int]:
    """Width and height that a capture says of an image, and the image's own, times `factor`, where it says none.
    Raises as the two above.
    """
    own = image_size(path)
    wide = factor * own[0] if width is None else width
    tall = factor * own[1] if height is None else height
    return pixel_size(where, wide, tall)


UNDISTORT = "undistort the images (`colmap image_undistorter` does) and write the cameras of those"
"""Remedy for lenses that cannot be represented."""


def lens_of(
    where: str, model: str, distortion: Sequence[float], others: Sequence[float] = (), remedy: str = UNDISTORT
) -> tuple[tuple[float, float, float, float, float, float], int]:
    """Distortion k1 k2 k3 k4 p1 p2 and lens of a camera model by COLMAP's name, whose `others` are its
    remaining parameters.

    A polynomial without terms is a pinhole. Raises DataError, opened by `where`, for what the lenses cannot
    represent.
    """
    if not np.isfinite([*distortion, *others]).all():
        raise UnusableView(where)
    k1, k2, k3, k4, p1, p2 = distortion
    if model == "EQUIRECTANGULAR":
        raise DataError(
            f"{where}: a panorama ({model}), which `colmap image_undistorter` cannot undistort either; cut the images "
            "into pinhole views, as COLMAP's panorama_sfm.py and `ns-process-data images --camera-type equirectangular` do"
        )
    # A lens that is close to one of ours would bend rays a little wrong: any term that is left over refuses
    # it.
    fisheye = "FISHEYE" in model
    if any(others) or (fisheye and (p1 or p2)) or (model.endswith("PINHOLE") and any(distortion)):
        if model.endswith("PINHOLE"):
            known = "no terms"
        elif fisheye:
            known = "k1 k2 k3 k4"
        else:
            known = "k1 k2 k3 k4 p1 p2 in a polynomial"
        raise DataError(f"{where}: the lens {model} has more terms than are represented ({known}); {remedy}")
    if fisheye:
        lens = FISHEYE
    else:
        lens = OPENCV if any(distortion) else PINHOLE
    return (k1, k2, k3, k4, p1, p2), lens


def quaternion_rotation(where: str, quaternion: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation [3 3] of a quaternion w x y z. Raises DataError, opened by `where`, unless its length is
    about 1.
    """
    length = math.hypot(*quaternion)
    if not math.isfinite(length):
        raise UnusableView(where)
    if not abs(length - 1) < _MAX_LENGTH_ERROR:
        raise DataError(
            f"{where}: a quaternion of length {length:.3g} is no rotation; export the capture again"
        )
    return rotations(torch.tensor(quaternion, dtype=torch.float64)[None])[0].numpy()


def rigid_pose(where: str, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """A camera-to-world pose [3 4] from [3 4] or [4 4], its rotation made orthonormal to rounding.

    Raises DataError, opened by `where`, for anything that is not a rotation and a finite position within
    1e-3.
    """
    if matrix.shape not in ((3, 4), (4, 4)):
        raise DataError(
            f"{where}: the pose has the shape {matrix.shape}, not 3x4 or 4x4; run the reconstruction again"
        )
    if not np.isfinite(matrix).all():
        raise UnusableView(where)
    if matrix.shape == (4, 4) and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise DataError(
            f"{where}: the pose's last row is {matrix[3].tolist()}; write 0 0 0 1, or leave that row out"
        )
    # Scale, shear or a mirroring would go unnoticed until renders are wrong.
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not deviation <= _MAX_SKEW or np.linalg.det(rotation) < 0:
        if not deviation <= _MAX_SKEW:
            kind = f"off by {deviation:.2g}, at most {_MAX_SKEW} is repaired"
        else:
            kind = "a reflection"
        raise DataError(
            f"{where}: the pose holds no rotation ({kind}); remove scale and shear from the capture's poses"
        )
    if np.abs(matrix[:3, 3]).max() > _MAX_COORDINATE:
        raise DataError(
            f"{where}: the position {matrix[:3, 3].tolist()} lies beyond {_MAX_COORDINATE:g}; run the reconstruction again"
        )
    # The nearest rotation: what is left of R = U S V^T without its stretching S.
    left, _, right = np.linalg.svd(rotation)
    return np.concatenate([left @ right, matrix[:3, 3:]], 1)
