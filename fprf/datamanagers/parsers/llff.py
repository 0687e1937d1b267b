"""LLFF captures: `poses_bounds.npy`, one row an image in the order of their names.

A row is a 3x5 matrix [R | t | (height, width, focal)] and the nearest and farthest depth. Columns of R are
the camera's down, right and back axes in the world; ours are right, up and back. The world frame is kept.
Points are those of the COLMAP model that the poses came from, where it is there.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ..images import image_names
from ..photograph_files import COPIES, equal_pictures, find_photographs, left_out_note
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene
from .colmap import cloud_of_model
from .config import LlffConfig
from .files import path_inside, read_bytes, read_npy, reduced_copies
from .views import View, pixel_size, read_views, rigid_pose


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
        folder = self._image_folder(data)
        names, left_out = _named_images(folder, len(rows))
        views, _, lost = read_views(
            data, enumerate(names), lambda each: _view(file, rows[each[0]], each[0], folder / each[1])
        )
        points, seen, said = cloud_of_model(data, views, np.eye(3, 4))
        contents = CaptureContents(
            views=views,
            points=points,
            seen=seen,
            reduced=True,
            notes=(*left_out, *lost, *_order_note(names), *said),
        )
        return assemble_scene(data, contents, downscale=downscale)

    def _image_folder(self, data: Path) -> Path:
        """The folder that is named, else the images as they were delivered, else the copies that are reduced
        least.
        """
        if self.config.images:
            return path_inside(data, "parser.images", self.config.images)[1]
        folder = data / "images"
        if folder.is_dir():
            return folder
        copies = reduced_copies(folder)
        if copies is None:
            raise DataError(
                f"{data}: poses_bounds.npy, but no folder images or images_N; put the images there"
            )
        return copies


def _named_images(folder: Path, count: int) -> tuple[list[str], list[str]]:
    """The names of the images that the rows are of, and notes on what else lies there. Raises DataError where no
    reading has as many.
    """
    every = image_names(folder)
    found = find_photographs(folder, below=False)
    if len(found.files) == count:
        return [path.name for path in found.files], found.notes()
    if len(every) == count:
        return every, []
    # Copies of an image are no images of the capture; by their names too, since rows go by the order of names.
    copies = []
    for path, original in equal_pictures(found.files).items():
        if original.stem in path.stem:
            copies.append(path)
    names = []
    for path in found.files:
        if path not in copies:
            names.append(path.name)
    if len(names) != count:
        raise DataError(
            f"{folder}: {len(every)} images, but poses_bounds.npy has {count} rows, one for each in the order of "
            "names; restore the images that it was made of, or run LLFF's imgs2poses again"
        )
    return names, [*found.notes(), left_out_note(COPIES, sorted(path.name for path in copies))]


def _order_note(names: list[str]) -> list[str]:
    """A note where numbers are in the order of text, not of their size."""
    numbers = all(Path(name).stem.isdecimal() for name in names)
    if not numbers or names == sorted(names, key=lambda name: (len(name), name)):
        return []
    return [f"rows of poses_bounds.npy are taken in LLFF's order of names: {', '.join(names[:3])}, ..."]


def _view(file: Path, row: NDArray[np.float64], number: int, path: Path) -> View:
    height, width, focal = row[:15].reshape(3, 5)[:, 4]
    # From down, right, back to right, up, back.
    matrix = row[:15].reshape(3, 5)[:, :4]
    turned = np.stack([matrix[:, 1], -matrix[:, 0], matrix[:, 2], matrix[:, 3]], 1)
    where = f"{file}: row {number} ({path.name})"
    # The principal point is the middle of the image, as in LLFF.
    size = pixel_size(where, width, height)
    return View(
        name=path.name,
        path=path,
        pose=rigid_pose(where, turned),
        size=size,
        focal=(float(focal), float(focal)),
        centre=(size[0] / 2, size[1] / 2),
        depths=(float(row[15]), float(row[16])),
    )
