"""From what a capture says of each view to a `ParsedScene`: exact poses, sizes and images checked against
files, masks.

`masks/` says what is used (black is left out: people, cars, the capture's own shadow), `sky_masks/` what is
sky (white). A mask of images/a/0001.jpg is masks/a/0001.jpg.png (as COLMAP has it), masks/a/0001.png or
masks/a/0001.jpg. Images without one are used whole; a folder in which no mask carries an image's name is
none.
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
from torch import Tensor

from ...errors import DataError
from ...rendering.cameras import Cameras
from ...rendering.lens import FISHEYE, OPENCV, PINHOLE
from ...rendering.splines import rotations
from ..images import has_transparency, read_header
from ..scene import ParsedScene
from .files import name_of


def index_tensor(members: Sequence[bool]) -> Tensor:
    """The int64 positions of the members."""
    return torch.tensor([k for k, member in enumerate(members) if member], dtype=torch.int64)


def split_by(held: Sequence[bool]) -> tuple[Tensor, Tensor] | None:
    """Indices (train, test), int64, of views of which some are held out; None where all or none are."""
    if len({*held}) > 1:
        return (index_tensor([not each for each in held]), index_tensor(held))
    return None


_LOOSE = 1e-3
"""Largest deviation of RᵀR from 1 that counts as rounding and is repaired."""
_FAR = 1e12
"""Largest coordinate of a camera: beyond it float64 has no millimetres left."""
_LOOKED_AT = 4
"""Images with an alpha channel that are decoded, at most, to see whether it says anything."""


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
            numbers = (*one.focal, *one.centre, *one.distortion)
            if not np.isfinite((*numbers, *(one.depths or ()))).all():
                raise UnusableView(str(one.path))
            if not os.path.isfile(one.path):
                raise _MissingImage(str(one.path))
        except UnusableView as fault:
            lost.append(fault.where)
            continue
        except _MissingImage as fault:
            missing.append(str(fault))
            continue
        # What is finite may still be no camera: nothing that would follow from it is worth having.
        if max(map(abs, numbers)) > 1e9:
            raise DataError(f"{one.path}: the camera's numbers {numbers} go beyond 1e9; calibrate again")
        if min(one.focal) <= 0:
            raise DataError(
                f"{one.path}: the focal length is {min(one.focal)}, it must be above 0; calibrate again"
            )
        if one.depths is not None and not 0 < one.depths[0] < one.depths[1]:
            raise DataError(
                f"{one.path}: nearest and farthest depth are {one.depths[0]} and {one.depths[1]}, "
                "0 < near < far is needed; remove or correct them"
            )
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
    if lost:
        notes = [f"{len(lost)} of {count} images are left out, whose camera is not finite: {lost[0]}"]
    else:
        notes = []
    if not views:
        raise DataError(f"{data}: no view is left: {'; '.join(notes)}; run the reconstruction again")
    return list(views.values()), kept, notes


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
    if min(size) < 1 or max(size) > 10**6:
        raise DataError(
            f"{where}: {width:g}x{height:g} pixels; a side has 1 to 1000000: correct it, or export it again"
        )
    return size


def stated_size(where: str, path: Path, width: float | None, height: float | None) -> tuple[int, int]:
    """Width and height that a capture says of an image, and the image's own where it says none. Raises as the
    two above.
    """
    own = image_size(path)
    return pixel_size(where, own[0] if width is None else width, own[1] if height is None else height)


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
    return (k1, k2, k3, k4, p1, p2), FISHEYE if fisheye else OPENCV if any(distortion) else PINHOLE


def quaternion_rotation(where: str, quaternion: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation [3 3] of a quaternion w x y z. Raises DataError, opened by `where`, unless its length is
    about 1.
    """
    length = math.hypot(*quaternion)
    if not math.isfinite(length):
        raise UnusableView(where)
    if not 0.9 < length < 1.1:
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
    if not deviation <= _LOOSE or np.linalg.det(rotation) < 0:
        if not deviation <= _LOOSE:
            kind = f"off by {deviation:.2g}, at most {_LOOSE} is repaired"
        else:
            kind = "a reflection"
        raise DataError(
            f"{where}: the pose holds no rotation ({kind}); remove scale and shear from the capture's poses"
        )
    if np.abs(matrix[:3, 3]).max() > _FAR:
        raise DataError(
            f"{where}: the position {matrix[:3, 3].tolist()} lies beyond {_FAR:g}; run the reconstruction again"
        )
    # The nearest rotation: what is left of R = U S V^T without its stretching S.
    left, _, right = np.linalg.svd(rotation)
    return np.concatenate([left @ right, matrix[:3, 3:]], 1)


def assemble_scene(
    data: Path,
    views: Sequence[View],
    *,
    downscale: float,
    split: tuple[Tensor, Tensor] | None = None,
    points: NDArray[np.float64] | None = None,
    seen: NDArray[np.int64] | None = None,
    reduced: bool = False,
    notes: Sequence[str] = (),
) -> ParsedScene:
    """The scene of at least one view, in the given order; without a split every 8th view is held out.

    The files' headers are read: their size must be the camera's, unless `reduced` says that the image folder
    holds smaller copies of the same shape, which the cameras are then scaled to.
    """
    # Sizes as the files have them, from headers alone.
    clear: list[Path] = []
    sizes = []
    for view in views:
        header = read_header(view.path)
        size = header.width, header.height
        # Reducing rounds each side to a whole pixel.
        same_shape = abs(view.size[0] * size[1] - view.size[1] * size[0]) <= sum(view.size)
        if not (view.size == size or (reduced and same_shape)):
            raise DataError(
                f"{view.path}: {size[0]}x{size[1]} pixels, but its camera has {view.size[0]}x{view.size[1]}; "
                "restore the image (was it resized, rotated or cropped?) or calibrate again"
            )
        clear += [view.path] * header.alpha
        sizes.append(size)
    # Cameras at the size that the capture states, brought to that of the files.
    delivered = Cameras(
        pose=torch.from_numpy(np.stack([view.pose for view in views])),
        focal=torch.tensor([view.focal for view in views], dtype=torch.float64),
        centre=torch.tensor([view.centre for view in views], dtype=torch.float64),
        size=torch.tensor([view.size for view in views], dtype=torch.int64),
        distortion=torch.tensor([view.distortion for view in views], dtype=torch.float64),
        lens=torch.tensor([view.lens for view in views], dtype=torch.int64),
    ).resized(torch.tensor(sizes))
    depths = [view.depths for view in views if view.depths is not None]
    # Every 8th, from the first on, is for testing (LLFF); but a single view is for training: there must be
    # something to learn.
    held = [k % 8 == 0 and len(views) > 1 for k in range(len(views))]
    train, test = split or (index_tensor([not each for each in held]), index_tensor(held))
    return ParsedScene(
        name=name_of(data),
        paths=tuple(view.path for view in views),
        cameras=delivered.scaled(downscale) if downscale != 1 else delivered,
        train=train,
        test=test,
        points=None if points is None or not len(points) else torch.from_numpy(points),
        seen=None if seen is None or not len(seen) else torch.from_numpy(seen),
        depths=torch.tensor(depths, dtype=torch.float64) if len(depths) == len(views) else None,
        masks=_masks(data, views, [view.mask for view in views], "masks"),
        sky_masks=_masks(data, views, [view.sky_mask for view in views], "sky_masks"),
        # Game engines and screenshots write alpha that is opaque everywhere: a few files tell.
        alpha=any(map(has_transparency, clear[:: -(-len(clear) // _LOOKED_AT) or 1])),
        notes=tuple(notes),
    )


def _masks(
    data: Path, views: Sequence[View], named: Sequence[Path | None], folder: str
) -> tuple[Path | None, ...]:
    """Masks of the views: those that the capture names, or where it names none, those that lie beside the
    images.
    """
    if any(named):
        missing = []
        for path in named:
            if path is not None and not os.path.isfile(path):
                missing.append(path)
        if missing:
            told = f"{len(missing)} masks are missing, the first is {missing[0]}"
            raise DataError(f"{data}: {told}; copy them there or unname them")
        return tuple(named)
    found: list[Path | None] = []
    for view in views:
        mask = None
        # Beside the image's folder, or beside a folder around that, up to the scene's; images may lie in that
        # itself.
        start = int(view.path.parent != data)
        for above in view.path.parents[start:]:
            if mask is None and (above / folder).is_dir():
                inner = (above / folder).joinpath(*view.path.relative_to(above).parts[start:])
                spellings = (inner.with_name(inner.name + ".png"), inner.with_suffix(".png"), inner)
                mask = next((path for path in spellings if path.is_file()), None)
            if above == data or not above.is_relative_to(data):
                break
        found.append(mask)
    return tuple(found) if any(found) else ()
