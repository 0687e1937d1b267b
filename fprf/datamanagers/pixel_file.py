"""Room for the pixels of many images: in memory while they are few, else in a file that is mapped and has no name.

The system keeps of a mapped file what memory there is to spare, and reads the rest again when it is drawn: thousands of images
need not fit. A file without a name ends with its process, however that ends.
"""

import os
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from ..io.atomic import unwritable

__all__ = ["HELD", "room_for"]

HELD = 512 * 2**20
"""Bytes of pixels that are simply held in memory."""


def room_for(pixels: int, folder: Path, held: int = HELD) -> Annotated[Tensor, "P 3"]:
    """Space for so many pixels, uint8, to be written to; mapped from a file in `folder` above `held` bytes.

    Raises DataError where the disk has no room for it.
    """
    size = 3 * pixels
    if size <= held:
        return torch.empty(pixels, 3, dtype=torch.uint8)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            _reserve(file.fileno(), size)
            mapped = np.memmap(file, dtype=np.uint8, mode="r+", shape=(pixels, 3))
    except OSError as error:
        raise unwritable(folder, error, size) from error
    return torch.from_numpy(np.asarray(mapped))


def _reserve(file: int, size: int) -> None:
    """Blocks for the whole file now: a write to a mapped file that the disk has no room for would end the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)
