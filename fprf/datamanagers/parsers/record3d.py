"""Record3D's exports of LiDAR videos: `metadata.json` with `rgb/` (EXR and JPG), or an unpacked .r3d:
`metadata` with `rgbd/`.

Images are numbered. `poses` has a row for each: a quaternion x y z w and the position, camera to world in
OpenGL axes, metres. `perFrameIntrinsicCoeffs` has fx fy cx cy for each image; without it `K` holds for all,
its 3x3 matrix column after column. Both are in pixels of the images, which are `w` by `h`, or as they are
where the file says nothing.
"""

import re
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...interfaces import DataParser
from ..images import image_names
from ..scene import ParsedScene
from .config import Record3DConfig, recording
from .files import as_record, read_json
from .views import View, assemble_scene, quaternion_rotation, read_views, rigid_pose, stated_size

_NUMBER = re.compile("[0-9]{1,9}")


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
        record = as_record(file, read_json(file))
        # Numbered images belong to the rows of poses.
        poses = record.table("poses", 7)
        numbered = sorted(
            (int(Path(name).stem), name) for name in image_names(folder) if _NUMBER.fullmatch(Path(name).stem)
        )
        posed = [each for each in numbered if each[0] < len(poses)]
        if not posed:
            last = numbered[-1][1] if numbered else "nothing numbered"
            raise DataError(
                f"{folder}: {last}, but {file.name} has {len(poses)} poses, from 0 on; export the recording again"
            )
        if len(poses) > 1 and not np.nan_to_num(np.ptp(poses, axis=0), nan=1.0).any():
            raise DataError(
                f"{file}: all poses are one (front cameras have none); find poses with `fprf process {folder}`"
            )
        # fx fy cx cy of each image, or one K for all.
        lenses = np.zeros((0, 4))
        if record.get("perFrameIntrinsicCoeffs") is not None:
            lenses = record.table("perFrameIntrinsicCoeffs", 4)
        if len(lenses) < len(poses):
            lenses = np.tile(record.numbers("K", 9)[[0, 4, 6, 7]], (len(poses), 1))
        # At most so many, evenly through the recording.
        even = np.linspace(0, len(posed) - 1, min(len(posed), self.config.frames)).round().astype(int)

        def view(each: tuple[int, str]) -> View:
            number, name = each
            fx, fy, cx, cy = lenses[number].tolist()
            where = f"{file}: poses[{number}]"
            row = poses[number]
            # The file has x y z w, we w x y z.
            turn = quaternion_rotation(where, row[[3, 0, 1, 2]])
            return View(
                name=name,
                path=folder / name,
                pose=rigid_pose(where, np.concatenate([turn, row[4:, None]], 1)),
                size=stated_size(str(file), folder / name, record.number("w"), record.number("h")),
                focal=(fx, fy),
                centre=(cx, cy),
            )

        views, _, notes = read_views(data, [posed[k] for k in even], view)
        if len(posed) < len(numbered):
            notes.append(
                f"{len(numbered) - len(posed)} of {len(numbered)} images have no pose and are left out"
            )
        return assemble_scene(data, views, downscale=downscale, notes=notes)
