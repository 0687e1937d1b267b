"""Polycam's raw data (LiDAR captures, developer mode): `keyframes/` with images and a JSON file for each
camera.

`corrected_images` and `corrected_cameras`, which Polycam writes after its global optimisation, are used for
each frame that both have; else `images` and `cameras`. `t_00` ... `t_23` are camera to world, three rows of
four, in OpenGL axes (ARKit's: y is up in the world); `fx fy cx cy width height` are in pixels, and files
without the last two belong to images as they are. The world frame is kept, in metres. An image without a
camera is left out.
"""

from pathlib import Path

import numpy as np

from ...errors import DataError
from ...interfaces import DataParser
from ..images import IMAGE_SUFFIXES
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene
from .config import keyframes
from .files import as_record, read_json
from .views import View, read_views, rigid_pose, stated_size


class PolycamParser(DataParser):
    """`keyframes/` of a raw export."""

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of its images."""
        folders = keyframes(data)
        if not folders:
            raise DataError(
                f"{data}: no keyframes/images with keyframes/cameras/*.json; export raw data from Polycam"
            )
        # Corrected frames come first and stay; images that no camera knows are counted.
        frames: dict[str, tuple[Path, Path]] = {}
        alone: set[str] = set()
        for images, cameras in folders:
            posed, every = _frames(images, cameras)
            frames = posed | frames
            alone |= every
        alone -= frames.keys()
        if not frames:
            images, cameras = folders[0]
            raise DataError(
                f"{cameras}: no file has the name of an image in {images}; export the raw data again"
            )
        views, kept, notes = read_views(data, [frames[stem] for stem in sorted(frames)], _view)
        corrected = sum(image.parent == folders[0][0] for image, _ in kept)
        if corrected < len(kept):
            notes.append(
                f"{corrected} of {len(kept)} frames are in {folders[0][0].name}; the others are taken as recorded"
            )
        if alone:
            notes.append(
                f"{len(alone)} of {len(alone) + len(frames)} images have no camera and are left out, like {min(alone)}"
            )
        return assemble_scene(data, CaptureContents(views=views, notes=notes), downscale=downscale)


def _frames(images: Path, cameras: Path) -> tuple[dict[str, tuple[Path, Path]], set[str]]:
    """Images with their cameras' files by their common stem, and the stems of all images."""
    known = set()
    for path in cameras.glob("[!.]*.json"):
        known.add(path.stem)
    posed = {}
    every = set()
    for path in images.glob("[!.]*"):
        if path.suffix.lower() in IMAGE_SUFFIXES:
            every.add(path.stem)
            if path.stem in known:
                posed[path.stem] = (path, cameras / f"{path.stem}.json")
    return posed, every


def _view(frame: tuple[Path, Path]) -> View:
    image, file = frame
    # t_RC is row R and column C of the pose; everything else has its plain name.
    record = as_record(file, read_json(file))
    rows = []
    for row in range(3):
        rows.append([record.needed(f"t_{row}{column}") for column in range(4)])
    fx, fy, cx, cy = (record.needed(key) for key in ("fx", "fy", "cx", "cy"))
    return View(
        name=image.name,
        path=image,
        pose=rigid_pose(str(file), np.array(rows)),
        size=stated_size(str(file), image, record.number("width"), record.number("height")),
        focal=(fx, fy),
        centre=(cx, cy),
    )
