"""What all files of Gaussians have in common: the capture that was read, rounding to integers, packed rotations.

Arrays are NumPy's. A reader never allocates on a file's word: what a header claims is held against the size of the file.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from ...errors import DataError
from ...ops.harmonics import HARMONIC
from ...rendering.local_frame import local_origin
from ...types import Origin
from ..gaussians import Gaussians, morton_order

Floats: TypeAlias = NDArray[Any]
Bools: TypeAlias = NDArray[np.bool_]

_EDGE = 1e-6
"""Opacities of exactly 0 and 1 have no logit: both keep this distance, far below a 16-bit step."""
_ROOT = 2**0.5


@dataclass(frozen=True, eq=False)
class Capture:
    """A file of Gaussians, as it was read."""

    path: Path
    gaussians: Gaussians
    antialiased: bool
    """Trained with opacities compensated for the width that drawing adds (Mip-Splatting)."""
    data: bytes
    """The file. Of a folder, its files as one archive."""
    recolour: Callable[[Floats, Bools], bytes]
    """The file with the harmonics [N K 3] of some Gaussians (bool [N]) replaced and everything else as it was."""
    shift: Origin = (0.0, 0.0, 0.0)
    """What was taken off the file's coordinates, which lie far from 0."""
    offset: Origin = (0.0, 0.0, 0.0)
    """What a file beside it adds to them (see `rendering.local_frame`)."""

    @property
    def origin(self) -> Origin:
        """Of the local frame that the Gaussians are in."""
        return self.shift[0] + self.offset[0], self.shift[1] + self.offset[1], self.shift[2] + self.offset[2]


def centred(means: Floats) -> tuple[NDArray[np.float64], Origin]:
    """Positions of any type about their local origin, and that."""
    means = means.astype(np.float64)
    shift = local_origin(torch.from_numpy(means))
    return means - shift, shift


def short(path: Path, has: int, needs: int, what: str) -> DataError:
    """The error for a file that holds less than its header says."""
    return DataError(f"{path}: {what} takes {needs} bytes, but the file has {has}; copy it again, it is cut off or damaged")


def steps(values: Floats, most: int) -> NDArray[np.int64]:
    """Values in [0, 1] as integers 0 to `most`, rounded; what lies outside is clipped, NaN becomes 0."""
    return np.rint(np.clip(np.nan_to_num(values.astype(np.float64), nan=0.0), 0, 1) * most).astype(np.int64)


def finite(values: Floats) -> NDArray[np.float64]:
    """Numbers in float64 whose differences are finite in float32, too: 0 for NaN, the largest such for infinite ones."""
    largest = 0.25 * float(np.finfo(np.float32).max)
    return np.clip(np.nan_to_num(values.astype(np.float64)), -largest, largest)


def sigmoid(x: Floats) -> Floats:
    """In [0, 1], without overflow."""
    return 0.5 * (1 + np.tanh(0.5 * x))


def logit(opacity: Floats) -> Floats:
    """The inverse of the sigmoid, finite."""
    inside = np.clip(opacity.astype(np.float64), _EDGE, 1 - _EDGE)
    return np.log(inside / (1 - inside))


def colours_of(harmonics: Floats) -> Floats:
    """Mean colours [N 3] of harmonics [N K 3]."""
    return 0.5 + HARMONIC * harmonics[:, 0].astype(np.float64)


def constants_of(colours: Floats) -> Floats:
    """Harmonics [N 1 3] of mean colours [N 3]."""
    return (colours[:, None].astype(np.float64) - 0.5) / HARMONIC


def smallest_three(quaternions: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Of unit quaternions [N 4], up to their sign: which component is the largest [N], and the others times sqrt 2 [N 3].

    The others lie in [-1, 1]. A quaternion of length 0 or NaN becomes the identity.
    """
    length = np.linalg.norm(quaternions.astype(np.float64), axis=1, keepdims=True)
    sound = np.isfinite(length) & (length > 0)
    unit = np.where(sound, quaternions, [1.0, 0.0, 0.0, 0.0]) / np.where(sound, length, 1.0)
    largest = np.abs(unit).argmax(1)
    rows = np.arange(len(unit))
    unit = unit * np.where(unit[rows, largest] < 0, -1.0, 1.0)[:, None]
    return largest, unit[rows[:, None], _OTHERS[largest]] * _ROOT


def three_to_four(largest: NDArray[np.int64], three: Floats) -> Floats:
    """The quaternions [N 4] of `smallest_three`."""
    rows, others = np.arange(len(three)), three / _ROOT
    out = np.empty((len(three), 4))
    out[rows[:, None], _OTHERS[largest]] = others
    out[rows, largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(1)))
    return out


def spatial_order(means: Floats) -> NDArray[np.int64]:
    """An order in which neighbours in space follow each other (Z-order curve of 1024 cells a side)."""
    sound = np.nan_to_num(means.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    low, high = sound.min(0), sound.max(0)
    cells = ((sound - low) / np.maximum(high - low, np.finfo(np.float32).tiny) * 1023).astype(np.int64)
    return morton_order(cells)


_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
