"""Mega-NeRF's layout (Mill 19, Quad 6k, UrbanScene3D): `train` and `val`, each with `metadata/NAME.pt` and
`rgbs/NAME.jpg`.

Metadata are tensors written by torch.save: `H W c2w intrinsics`. They are read without running any code that
they name. Poses are OpenGL's, in world axes down, right, back; `coordinates.pt` tells how many metres their
unit is.
"""

from pathlib import Path
from typing import Any

import torch

from ...errors import DataError
from ...interfaces import DataParser
from ..images import IMAGE_SUFFIXES
from ..scene import ParsedScene
from .assembly import CaptureContents, assemble_scene, split_by
from .files import image_folder
from .views import View, read_views, rigid_pose, stated_size

_MAX_METADATA_BYTES = 1 << 24
"""Bytes of a file of metadata, which takes a few thousand: by eye."""
_MAX_UNIT = 1e9
"""Metres of a unit of the poses that are believed: by eye."""


class MegaNerfParser(DataParser):
    """`train` and `val` folders."""

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of the delivered size; `val` is held out. Lengths are metres where the
        capture says.
        """
        unit = _metres(data)
        # Both parts in one order by name.
        files: list[tuple[Path, Path]] = []
        said: list[str] = []
        for part in ("train", "val"):
            folder = data / part / "metadata"
            images, notes = image_folder(data / part / "rgbs")
            for file in folder.glob("[!.]*.pt"):
                files.append((file, images))
            said += notes
            if not files:
                raise DataError(
                    f"{folder}: no *.pt files; name the folder of a scene, with train/metadata and train/rgbs in it"
                )
        files.sort(key=lambda each: each[0].stem)
        views, kept, lost = read_views(data, files, lambda each: _view(*each, unit))
        split = split_by([file.parents[1].name == "val" for file, _ in kept])
        contents = CaptureContents(views=views, split=split, reduced=True, notes=(*said, *lost))
        return assemble_scene(data, contents, downscale=downscale)


def _metres(data: Path) -> float:
    """Metres of a unit of the poses; 1 where nothing is said."""
    path = data / "coordinates.pt"
    if not path.is_file():
        return 1.0
    try:
        unit = float(_load(path).get("pose_scale_factor", 1.0))
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataError(
            f"{path}: pose_scale_factor is no number ({_first_line(error)}); write it again"
        ) from error
    if not 0 < unit < _MAX_UNIT:
        raise DataError(f"{path}: pose_scale_factor is {unit}; it must be above 0: write it again")
    return unit


def _load(path: Path) -> dict[str, Any]:
    """Tensors and numbers by name; nothing else is let in."""
    # Unpickling may take many times the memory of its file.
    if path.is_file() and path.stat().st_size > _MAX_METADATA_BYTES:
        raise DataError(
            f"{path}: larger than {_MAX_METADATA_BYTES} bytes, so no metadata of one image; copy it again"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the unpickler raises whatever the bytes lead it to
        raise DataError(
            f"{path}: no tensors of torch.save ({_first_line(error)}); copy the file again"
        ) from error
    if not isinstance(content, dict):
        raise DataError(
            f"{path}: holds a {type(content).__name__}, not names and tensors; copy the file again"
        )
    return content


def _first_line(error: Exception) -> str:
    if str(error):
        return str(error).splitlines()[0]
    return type(error).__name__


def _view(file: Path, images: Path, unit: float) -> View:
    # The image may have any ending.
    metadata = _load(file)
    paths = []
    for suffix in sorted(IMAGE_SUFFIXES):
        paths.append(images / f"{file.stem}{suffix}")
    path = next((path for path in paths if path.is_file()), images / f"{file.stem}.jpg")
    try:
        width, height = (None if key not in metadata else float(metadata[key]) for key in "WH")
        size = stated_size(str(file), path, width, height)
        matrix = torch.as_tensor(metadata["c2w"]).double().numpy()
        fx, fy, cx, cy = (float(v) for v in torch.as_tensor(metadata["intrinsics"]).reshape(-1).tolist())
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        told = f"{file}: c2w [3 4] and intrinsics [4] are needed ({_first_line(error)}); copy the file again"
        raise DataError(told) from error
    pose = rigid_pose(str(file), matrix) * [1, 1, 1, unit]
    return View(name=file.stem, path=path, pose=pose, size=size, focal=(fx, fy), centre=(cx, cy))
