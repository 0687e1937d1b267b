"""Parts of frozen encoders: padding that any size survives, tensors that no optimiser sees, pictures to
measure them on.
"""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Annotated

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...interfaces import Encoder


def freeze(module: nn.Module) -> None:
    """Evaluation mode, no gradients to the weights."""
    module.eval()
    module.requires_grad_(False)


def reflect_pad(x: Annotated[Tensor, "B C H W"]) -> Annotated[Tensor, "B C H+2 W+2"]:
    """Mirror at the borders; repeat them where an axis is too short to mirror."""
    return F.pad(x, (1, 1, 1, 1), mode="reflect" if min(x.shape[-2:]) > 1 else "replicate")


def replicate_to_multiple(x: Annotated[Tensor, "B C H W"], stride: int) -> Tensor:
    """Repeat the last row and column until both axes are multiples of `stride`."""
    right = -x.shape[-1] % stride
    below = -x.shape[-2] % stride
    if right or below:
        return F.pad(x, (0, right, 0, below), mode="replicate")
    return x


CELLS = 22
"""Patches along the longer side of an image where no stride is asked for."""


def patch_grid(size: Sequence[int], stride: int | None) -> tuple[int, int]:
    """Rows and columns of patches that cover an image of that height and width: one for `stride` pixels; None
    = `CELLS` along its longer side.
    """
    # At least one each way, however thin the image is.
    height, width = size
    pixels = stride or max(size) / CELLS
    return max(1, round(height / pixels)), max(1, round(width / pixels))


class FrozenEncoder(Encoder):
    """An encoder that knows its identity and channels when it is built."""

    def __init__(self, identity: str, channels: int) -> None:
        super().__init__()
        self._identity = identity
        self._channels = channels

    @property
    def identity(self) -> str:
        """Name, settings and a hash of every tensor that is used."""
        return self._identity

    @property
    def channels(self) -> int:
        return self._channels


@cache
def street() -> Annotated[Tensor, "5 3 128 160"]:
    """Sky, plants, walls and a road, from day to night, in [0, 1]: five views of the town of benchmarks/town,
    seed 0.
    """
    stored = np.frombuffer((files(__package__) / "weights/street.webp").read_bytes(), np.uint8)
    strip = cv2.imdecode(stored, cv2.IMREAD_COLOR_RGB)  # lossless, one view below the other
    assert strip is not None
    return torch.from_numpy(strip).reshape(5, 128, 160, 3).permute(0, 3, 1, 2).float() / 255
