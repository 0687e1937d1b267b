"""Pictures that callers in Python hold in memory, as files: everything that reads photographs reads files."""

import atexit
import hashlib
import os
import shutil
import tempfile
from collections.abc import Sequence
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps
from torch import Tensor

from ..errors import DataError
from .atomic import write_bytes
from .images import to_uint8
from .paths import PathLike, as_path

Photograph: TypeAlias = PathLike | Image.Image | NDArray[Any] | Tensor
"""A file, or a picture in memory: of Pillow, or [H W 3] as uint8 or as floats in [0, 1], sRGB."""

_PNG_MODES = ("L", "LA", "RGB", "RGBA")
"""Modes of Pillow that PNG holds and readers of photographs take as they are."""


def photograph_files(photographs: Photograph | Sequence[Photograph]) -> tuple[Path, ...]:
    """The files of one photograph or several; pictures in memory are written as PNG into a temporary folder, which
    goes with the process.

    Raises DataError for an array that is no picture, and for what is no photograph at all.
    """
    if isinstance(photographs, str | Image.Image | np.ndarray | Tensor) or not isinstance(
        photographs, Sequence
    ):
        photographs = [photographs]
    return tuple(map(_file, photographs))


def is_temporary(path: Path) -> bool:
    """True for a file that `photograph_files` has written."""
    return path.parent == _folder()


@cache
def _folder() -> Path:
    """Folder of this process's pictures."""
    folder = Path(tempfile.mkdtemp(prefix="fprf-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _file(photograph: Photograph) -> Path:
    """The file of one photograph."""
    if isinstance(photograph, Tensor):
        photograph = photograph.detach().cpu().numpy()
    if isinstance(photograph, np.ndarray):
        photograph = _pictured(photograph)
    if isinstance(photograph, str | os.PathLike):
        return as_path(photograph)
    if not isinstance(photograph, Image.Image):
        raise DataError(
            f"references: {photograph!r:.60}; a photograph is a file's path, a picture of Pillow, or an array [H W 3]"
        )
    # Upright, as readers of files have it; the profile of its colours stays with it.
    upright = ImageOps.exif_transpose(photograph)
    if upright.mode not in _PNG_MODES:
        upright = upright.convert("RGBA" if upright.has_transparency_data else "RGB")
    data = BytesIO()
    upright.save(data, "png", icc_profile=photograph.info.get("icc_profile"), compress_level=1)
    content = data.getvalue()
    file = _folder() / f"{hashlib.sha256(content).hexdigest()[:16]}.png"
    if not file.exists():
        write_bytes(file, content)
    return file


def _pictured(array: NDArray[Any]) -> Image.Image:
    """An array [H W 3], or [H W 4] with straight alpha, as a picture."""
    if array.ndim != 3 or array.shape[2] not in (3, 4) or 0 in array.shape:
        raise DataError(
            f"references: an array of shape {list(array.shape)}; a picture is [H W 3], uint8 or floats in [0, 1]"
        )
    if np.issubdtype(array.dtype, np.floating):
        if not (np.isfinite(array).all() and array.min() >= 0 and array.max() <= 1):
            raise DataError("references: floats outside of [0, 1]; divide by 255, or give uint8")
        array = to_uint8(torch.from_numpy(np.ascontiguousarray(array, np.float32)))
    if array.dtype != np.uint8:
        raise DataError(f"references: an array of {array.dtype}; a picture is uint8, or floats in [0, 1]")
    return Image.fromarray(np.ascontiguousarray(array))
