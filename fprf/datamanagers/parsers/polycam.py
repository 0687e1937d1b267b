"""Polycam's raw data (LiDAR captures, developer mode): `keyframes/` with images and a JSON file for each camera.

`corrected_images` and `corrected_cameras`, which Polycam writes after its global optimisation, are used where they are; else
`images` and `cameras`. `t_00` ... `t_23` are camera to world, three rows of four, in OpenGL axes (ARKit's: y is up in the
world); `fx fy cx cy width height` are in pixels. The world frame is kept, in metres. An image without a camera is left out.
"""

from pathlib import Path

import numpy as np

from ...errors import DataError
from ...interfaces import DataParser
from ..images import image_names
from ..scene import Scene
from .config import PolycamConfig
from .files import Record, as_record, read_json
from .views import View, assemble_scene, pixel_size, rigid_pose

_PAIRS = (("corrected_images", "corrected_cameras"), ("images", "cameras"))


def keyframes(data: Path) -> tuple[Path, Path] | None:
    """Folders of images and cameras in a scene folder, or None: either may be `keyframes` or hold it."""
    for root in (data / "keyframes", data):
        for images, cameras in _PAIRS:
            if (root / images).is_dir() and (root / cameras).is_dir() and next((root / cameras).glob("*.json"), None):
                return root / images, root / cameras
    return None


class PolycamParser(DataParser):
    """`keyframes/` of a raw export."""

    def __init__(self, config: PolycamConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene at 1/downscale of its images."""
        folders = keyframes(data)
        if folders is None:
            raise DataError(f"{data}: no keyframes/images with keyframes/cameras/*.json; export raw data from Polycam")
        images, cameras = folders
        named = [(images / name, cameras / f"{Path(name).stem}.json") for name in image_names(images)]
        views = [_view(image, file) for image, file in named if file.is_file()]
        if not views:
            raise DataError(f"{cameras}: no file has the name of an image in {images}; export the raw data again")
        return assemble_scene(data, views, downscale=downscale)


def _view(image: Path, file: Path) -> View:
    record = as_record(file, read_json(file))
    rows = [[_number(record, f"t_{row}{column}") for column in range(4)] for row in range(3)]
    width, height, fx, fy, cx, cy = (_number(record, key) for key in ("width", "height", "fx", "fy", "cx", "cy"))
    return View(
        name=image.name,
        path=image,
        pose=rigid_pose(str(file), np.array(rows)),
        size=pixel_size(str(file), width, height),
        focal=(fx, fy),
        centre=(cx, cy),
    )


def _number(record: Record, key: str) -> float:
    value = record.number(key)
    if value is None:
        raise DataError(f"{record.where}: {key} is missing; export the raw data again")
    return value
