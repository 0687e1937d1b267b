"""LLFF captures: `poses_bounds.npy`, one row an image in the order of their names.

A row is a 3x5 matrix [R | t | (height, width, focal)] and the nearest and farthest depth. Columns of R are
the camera's down, right and back axes in the world; ours are right, up and back. The world frame is kept.
Points are those of the COLMAP model that the poses came from, where it is there.
"""

import re
from pathlib import Path

import numpy as np

from ...errors import DataError
from ...interfaces import DataParser
from ..images import image_names
from ..scene import ParsedScene
from .colmap import cloud_of_model
from .config import LlffConfig
from .files import path_inside, read_bytes, read_npy
from .views import View, assemble_scene, pixel_size, read_views, rigid_pose


class LlffParser(DataParser):
    """`poses_bounds.npy` beside a folder of images."""

    def __init__(self, config: LlffConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of the images in the chosen folder, whatever size the poses were estimated
        at.
        """
        file = data / "poses_bounds.npy"
        rows = read_npy(str(file), read_bytes(file))
        if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
            raise DataError(
                f"{file}: an array of shape {rows.shape}; LLFF has one row of 17 numbers an image"
            )
        # The folder that is named, else the images as they were delivered, else the copies that are reduced
        # least.
        reduced = []
        for path in data.glob("images_*"):
            if re.fullmatch(r"images_[0-9]{1,4}", path.name) and path.is_dir():
                reduced.append(path)
        if self.config.images:
            folder = path_inside(data, "parser.images", self.config.images)[1]
        elif (data / "images").is_dir():
            folder = data / "images"
        elif reduced:
            folder = min(reduced, key=lambda path: int(path.name.removeprefix("images_")))
        else:
            raise DataError(
                f"{data}: poses_bounds.npy, but no folder images or images_N; put the images there"
            )
        names = image_names(folder)
        if len(names) != len(rows):
            raise DataError(
                f"{folder}: {len(names)} images, but poses_bounds.npy has {len(rows)} rows, one for each in the order of "
                "names; restore the images that it was made of, or run LLFF's imgs2poses again"
            )

        def view(each: tuple[int, str]) -> View:
            number, name = each
            row = rows[number]
            height, width, focal = row[:15].reshape(3, 5)[:, 4]
            # From down, right, back to right, up, back.
            matrix = row[:15].reshape(3, 5)[:, :4]
            turned = np.stack([matrix[:, 1], -matrix[:, 0], matrix[:, 2], matrix[:, 3]], 1)
            where = f"{file}: row {number} ({name})"
            # The principal point is the middle of the image, as in LLFF.
            size = pixel_size(where, width, height)
            return View(
                name=name,
                path=folder / name,
                pose=rigid_pose(where, turned),
                size=size,
                focal=(float(focal), float(focal)),
                centre=(size[0] / 2, size[1] / 2),
                depths=(float(row[15]), float(row[16])),
            )

        views, _, notes = read_views(data, enumerate(names), view)
        points, seen, said = cloud_of_model(data, views, np.eye(3, 4))
        if names != sorted(names, key=lambda name: (len(name), name)) and all(
            Path(name).stem.isdecimal() for name in names
        ):
            notes.append(
                f"rows of poses_bounds.npy are taken in LLFF's order of names: {', '.join(names[:3])}, ..."
            )
        notes += said
        return assemble_scene(
            data, views, downscale=downscale, points=points, seen=seen, reduced=True, notes=notes
        )
