"""Record3D's exports of LiDAR videos: `metadata.json` with `rgb/` (EXR and JPG), or an unpacked .r3d: `metadata` with `rgbd/`.

Images are numbered. `poses` has a row for each: a quaternion x y z w and the position, camera to world in OpenGL axes, metres.
`perFrameIntrinsicCoeffs` has fx fy cx cy for each image; without it `K` holds for all, its 3x3 matrix column after column.
Both are in pixels of the images, which are `w` by `h`.
"""

from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ...rendering.splines import rotations
from ..scene import Scene
from .config import Record3DConfig
from .files import Json, as_record, image_names, read_json
from .views import View, assemble_scene, rigid_pose

_Rows: TypeAlias = NDArray[np.float64]
_PAIRS = (("metadata.json", "rgb"), ("metadata", "rgbd"), ("metadata", "rgb"), ("metadata.json", "rgbd"))
_MOST = 1e6
"""Pixels of a side."""


def recording(data: Path) -> tuple[Path, Path] | None:
    """The metadata and the folder of images in a scene folder, or None."""
    pairs = ((data / file, data / images) for file, images in _PAIRS)
    return next(((file, images) for file, images in pairs if file.is_file() and images.is_dir()), None)


class Record3DParser(DataParser):
    """Numbered images with a row of numbers each."""

    def __init__(self, config: Record3DConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene at 1/downscale of its images: at most `frames` of them, evenly through the recording."""
        files = recording(data)
        if files is None:
            raise DataError(f"{data}: no metadata.json with rgb/; export from Record3D as EXR and JPG, or unpack its .r3d")
        file, folder = files
        record = as_record(file, read_json(file))
        poses = _table(file, "poses", record.get("poses"), 7)
        numbered = sorted((int(Path(name).stem), name) for name in image_names(folder) if _numbered(name))
        if not numbered or numbered[-1][0] >= len(poses):
            last = numbered[-1][1] if numbered else "nothing numbered"
            raise DataError(f"{folder}: {last}, but {file.name} has {len(poses)} poses, from 0 on; export the recording again")
        if len(poses) > 1 and not np.ptp(poses, axis=0).any():
            raise DataError(f"{file}: all poses are one (front cameras have none); find poses with `fprf process {folder}`")
        width, height = record.number("w") or 0.0, record.number("h") or 0.0
        if not (1 <= width <= _MOST and 1 <= height <= _MOST):
            raise DataError(f"{file}: w and h are {width:g} and {height:g}; the size of the images in pixels is needed")
        lenses = _lenses(file, record.get("perFrameIntrinsicCoeffs"), record.get("K"), len(poses))
        even = np.linspace(0, len(numbered) - 1, min(len(numbered), self.config.frames)).round().astype(int)
        views = []
        for number, name in (numbered[k] for k in even):
            fx, fy, cx, cy = (float(v) for v in lenses[number])
            views.append(
                View(
                    name=name,
                    path=folder / name,
                    pose=_pose(f"{file}: poses[{number}]", poses[number]),
                    size=(round(width), round(height)),
                    focal=(fx, fy),
                    centre=(cx, cy),
                )
            )
        return assemble_scene(data, views, downscale=downscale)


def _numbered(name: str) -> bool:
    stem = Path(name).stem
    return stem.isascii() and stem.isdigit() and len(stem) <= 9


def _pose(where: str, row: _Rows) -> _Rows:
    length = float(np.linalg.norm(row[:4]))
    if not 0.9 < length < 1.1:
        raise DataError(f"{where}: a quaternion of length {length:.3g} is no rotation; export the recording again")
    x, y, z, w = row[:4] / length
    turn = rotations(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    return rigid_pose(where, np.concatenate([turn, row[4:, None]], 1))


def _lenses(file: Path, each: Json, all_: Json, count: int) -> _Rows:
    """fx fy cx cy of each image."""
    if each is not None:
        rows = _table(file, "perFrameIntrinsicCoeffs", each, 4)
        if len(rows) == count:
            return rows
    k = _table(file, "K", [all_], 9)[0].reshape(3, 3).T
    return np.tile([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], (count, 1))


def _table(file: Path, key: str, value: Json, width: int) -> _Rows:
    """A list of rows of so many numbers."""
    rows = value if isinstance(value, list) else []
    cells = [cell for row in rows if isinstance(row, list) and len(row) == width for cell in row]
    numbers = [float(c) for c in cells if isinstance(c, int | float) and not isinstance(c, bool) and abs(c) < 1e300]
    if not rows or len(numbers) != width * len(rows):
        raise DataError(f"{file}: {key} is no list of {width} numbers each; export the recording again")
    return np.array(numbers).reshape(-1, width)
