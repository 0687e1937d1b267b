"""COLMAP models to scenes.

COLMAP's lenses become ours; its world-to-camera poses in OpenCV axes become camera-to-world in OpenGL's. The world frame
is kept. Each view's depths are the 0.1 and 99.9 percentile of the points that it observes (LLFF's rule).
"""

import math
from collections import Counter
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...errors import DataError
from ...interfaces import DataParser
from ...rendering.lens import FISHEYE, OPENCV, PINHOLE
from ..scene import Scene
from .colmap_model import ColmapCamera, ColmapImage, ColmapModel, read_model
from .config import ColmapConfig
from .files import inside
from .seen import pairs
from .views import View, assemble, rigid

__all__ = ["ColmapParser", "model_folder"]

_Lens: TypeAlias = tuple[tuple[float, float], tuple[float, float], tuple[float, float, float, float, float, float], int]


def model_folder(data: Path) -> Path | None:
    """Where the folder's sparse model lies, or None."""
    for folder in (data / "sparse" / "0", data / "sparse", data):
        if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
            return folder
    return None


class ColmapParser(DataParser):
    """A sparse model and the folder of its images."""

    def __init__(self, config: ColmapConfig) -> None:
        self.config = config

    def parse(self, data: Path, downscale: int) -> Scene:
        """The scene at 1/downscale of the size of the images in the chosen folder."""
        folder = model_folder(data)
        if folder is None:
            raise DataError(f"{data}: no cameras.bin or cameras.txt in sparse/0, sparse or here; run COLMAP's mapper")
        model = read_model(folder)
        if not model.images:
            raise DataError(f"{folder}: the model has no images; run COLMAP's mapper again")
        name, root = inside(data, "parser.images", self.config.images)
        index = dict(zip(model.point_ids.tolist(), range(len(model.point_ids)), strict=True))
        lenses = {id_: _lens(f"{folder}: camera {id_}", camera) for id_, camera in model.cameras.items()}
        images = sorted(model.images, key=lambda image: inside(root, f"{folder}: image {image.name!r}", image.name)[0])
        views = []
        for image in images:
            where = f"{folder}: image {image.name!r}"
            if image.camera not in lenses:
                raise DataError(f"{where}: its camera {image.camera} is not in the model; export the model again")
            camera = model.cameras[image.camera]
            focal, centre, distortion, lens = lenses[image.camera]
            inner, path = inside(root, where, image.name)
            pose = _pose(where, image)
            views.append(
                View(
                    name=inner,
                    path=path,
                    pose=pose,
                    size=(camera.width, camera.height),
                    focal=focal,
                    centre=centre,
                    distortion=distortion,
                    lens=lens,
                    depths=_depths(model, index, image, pose),
                )
            )
        twice = [inner for inner, times in Counter(view.name for view in views).items() if times > 1]
        if twice:
            raise DataError(f"{folder}: the image {twice[0]!r} is registered twice; export the model again")
        points, seen = pairs(model, images)
        return assemble(data, views, downscale=downscale, points=points, seen=seen, reduced=name != "images")


def _pose(where: str, image: ColmapImage) -> NDArray[np.float64]:
    q = np.array(image.quaternion)
    length = math.hypot(*image.quaternion)
    if not 0.9 < length < 1.1:
        raise DataError(f"{where}: the quaternion {q.tolist()} has not length 1; export the model again")
    w, x, y, z = q / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    back = rotation.T
    # A damaged translation may overflow; `rigid` refuses what is not finite.
    with np.errstate(over="ignore", invalid="ignore"):
        centre = -back @ np.array(image.translation)
    return rigid(where, np.stack([back[:, 0], -back[:, 1], -back[:, 2], centre], 1))


def _lens(where: str, camera: ColmapCamera) -> _Lens:
    """Focal lengths, principal point, k1 k2 k3 k4 p1 p2 and lens of a COLMAP camera."""
    p = camera.params
    if not (1 <= camera.width <= 10**6 and 1 <= camera.height <= 10**6):
        raise DataError(f"{where}: {camera.width}x{camera.height} pixels; export the model again")
    shared = camera.model.startswith("SIMPLE") or camera.model in ("RADIAL", "RADIAL_FISHEYE")
    focal, centre, k = ((p[0], p[0]), (p[1], p[2]), p[3:]) if shared else ((p[0], p[1]), (p[2], p[3]), p[4:])
    match camera.model:
        case "SIMPLE_PINHOLE" | "PINHOLE":
            return focal, centre, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), PINHOLE
        case "SIMPLE_RADIAL" | "SIMPLE_RADIAL_FISHEYE":
            bent = (k[0], 0.0, 0.0, 0.0, 0.0, 0.0)
        case "RADIAL" | "RADIAL_FISHEYE":
            bent = (k[0], k[1], 0.0, 0.0, 0.0, 0.0)
        case "OPENCV":
            bent = (k[0], k[1], 0.0, 0.0, k[2], k[3])
        case "OPENCV_FISHEYE":
            bent = (k[0], k[1], k[2], k[3], 0.0, 0.0)
        case "FULL_OPENCV" if not any(k[5:]):
            bent = (k[0], k[1], k[4], 0.0, k[2], k[3])
        case _:
            raise DataError(
                f"{where}: the lens {camera.model} with parameters {list(k)} cannot be represented; "
                "run `colmap image_undistorter` and use its output"
            )
    return focal, centre, bent, FISHEYE if camera.model.endswith("FISHEYE") else OPENCV if any(bent) else PINHOLE


def _depths(
    model: ColmapModel, index: dict[int, int], image: ColmapImage, pose: NDArray[np.float64]
) -> tuple[float, float] | None:
    """Bounds of the depths of the points that an image observes; None where they are too few for a percentile."""
    rows = [index[point] for point in image.observed.tolist() if point in index]
    # Damaged coordinates may overflow; what is not finite is left out.
    with np.errstate(over="ignore", invalid="ignore"):
        depth = (model.points[rows] - pose[:, 3]) @ -pose[:, 2]
    depth = depth[np.isfinite(depth) & (depth > 0)]
    near, far = np.percentile(depth, (0.1, 99.9)) if len(depth) >= 8 else (0.0, 0.0)
    return (float(near), float(far)) if 0 < near < far else None
