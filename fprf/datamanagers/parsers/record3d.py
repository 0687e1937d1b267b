"""Record3D's exports of LiDAR videos: `metadata.json` with `rgb/` (EXR and JPG), or an unpacked .r3d:
`metadata` with `rgbd/`.

Images are numbered. `poses` has a row for each: a quaternion x y z w and the position, camera to world in
OpenGL axes, metres. `perFrameIntrinsicCoeffs` has fx fy cx cy for each image; without it `K` holds for all,
its 3x3 matrix column after column. Both are in pixels of the images, which are `w` by `h`, or as they are
where the file says nothing.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ..photograph_files import find_photographs, left_out_note
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene
from .config import Record3DConfig, recording
from .files import Record, as_record, read_json
from .views import View, quaternion_rotation, read_views, rigid_pose, stated_size

_FRAME_NUMBER = re.compile("[0-9]{1,9}")


class Record3DParser(DataParser):
    """Numbered images with a row of numbers each."""

    def __init__(self, config: Record3DConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of its images: at most `frames` of them, evenly through the recording."""
        files = recording(data)
        if files is None:
            raise DataError(
                f"{data}: no metadata.json with rgb/; export from Record3D as EXR and JPG, or unpack its .r3d"
            )
        file, folder = files
        recorded = _read_recording(file)
        # Numbered images belong to the rows of poses.
        found = find_photographs(folder, below=False)
        numbered = []
        others = []
        for path in found.files:
            if _FRAME_NUMBER.fullmatch(path.stem):
                numbered.append((int(path.stem), path.name))
            else:
                others.append(path.name)
        numbered.sort()
        count = len(recorded.poses)
        posed = []
        for each in numbered:
            if each[0] < count:
                posed.append(each)
        if not posed:
            if numbered:
                last = numbered[-1][1]
            else:
                last = "nothing numbered"
            raise DataError(
                f"{folder}: {last}, but {file.name} has {count} poses, from 0 on; export the recording again"
            )
        if count > 1 and not np.nan_to_num(np.ptp(recorded.poses, axis=0), nan=1.0).any():
            raise DataError(
                f"{file}: all poses are one (front cameras have none); find poses with `fprf process {folder}`"
            )
        # At most so many, evenly through the recording.
        even = np.linspace(0, len(posed) - 1, min(len(posed), self.config.frames)).round().astype(int)
        views, _, notes = read_views(
            data, [posed[k] for k in even], lambda each: _view(recorded, each[0], folder / each[1])
        )
        if len(posed) < len(numbered):
            notes.append(
                f"{len(numbered) - len(posed)} of {len(numbered)} images have no pose and are left out"
            )
        if others:
            notes.append(left_out_note("images that are not numbered", others))
        contents = CaptureContents(views=views, notes=(*found.notes(), *notes))
        return assemble_scene(data, contents, downscale=downscale)


class _Recording(NamedTuple):
    """Metadata of a capture."""

    record: Record
    poses: NDArray[np.float64]
    """Rows of a quaternion x y z w and a position."""
    lenses: NDArray[np.float64]
    """fx fy cx cy of each."""


def _read_recording(file: Path) -> _Recording:
    record = as_record(file, read_json(file))
    poses = record.table("poses", 7)
    # fx fy cx cy of each image, or one K for all.
    lenses = np.zeros((0, 4))
    if record.get("perFrameIntrinsicCoeffs") is not None:
        lenses = record.table("perFrameIntrinsicCoeffs", 4)
    if len(lenses) < len(poses):
        lenses = np.tile(record.numbers("K", 9)[[0, 4, 6, 7]], (len(poses), 1))
    return _Recording(record, poses, lenses)


def _view(recorded: _Recording, number: int, path: Path) -> View:
    record = recorded.record
    fx, fy, cx, cy = recorded.lenses[number].tolist()
    where = f"{record.where}: poses[{number}]"
    row = recorded.poses[number]
    # The file has x y z w, we w x y z.
    turn = quaternion_rotation(where, row[[3, 0, 1, 2]])
    return View(
        name=path.name,
        path=path,
        pose=rigid_pose(where, np.concatenate([turn, row[4:, None]], 1)),
        size=stated_size(record.where, path, record.number("w"), record.number("h")),
        focal=(fx, fy),
        centre=(cx, cy),
    )
