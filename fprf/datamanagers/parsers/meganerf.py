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
from .views import View, assemble_scene, read_views, rigid_pose, split_by, stated_size

_LARGEST = 1 << 24
"""Bytes of a file of metadata."""


class MegaNerfParser(DataParser):
    """`train` and `val` folders."""

    def parse(self, data: Path, downscale: float) -> ParsedScene:
        """The scene at 1/downscale of the delivered size; `val` is held out. Lengths are metres where the
        capture says.
        """
        # Metres of a unit of the poses; 1 where nothing is said.
        unit = 1.0
        path = data / "coordinates.pt"
        if path.is_file():
            try:
                unit = float(_load(path).get("pose_scale_factor", 1.0))
            except (TypeError, ValueError, RuntimeError, OverflowError) as error:
                raise DataError(
                    f"{path}: pose_scale_factor is no number ({_first_line(error)}); write it again"
                ) from error
            if not 0 < unit < 1e9:
                raise DataError(f"{path}: pose_scale_factor is {unit}; it must be above 0: write it again")
        # Both parts in one order by name.
        files: list[tuple[Path, str]] = []
        for split in ("train", "val"):
            folder = data / split / "metadata"
            files += [(file, split) for file in folder.glob("[!.]*.pt")]
            if not files:
                raise DataError(
                    f"{folder}: no *.pt files; name the folder of a scene, with train/metadata and train/rgbs in it"
                )
        files.sort(key=lambda each: each[0].stem)
        views, kept, notes = read_views(
            data, files, lambda each: _view(each[0], data / each[1] / "rgbs", unit)
        )
        parts = split_by([split == "val" for _, split in kept])
        return assemble_scene(data, views, downscale=downscale, split=parts, reduced=True, notes=notes)


def _load(path: Path) -> dict[str, Any]:
    """Tensors and numbers by name; nothing else is let in."""
    # Unpickling may take many times the memory of its file.
    if path.is_file() and path.stat().st_size > _LARGEST:
        raise DataError(f"{path}: larger than {_LARGEST} bytes, so no metadata of one image; copy it again")
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
