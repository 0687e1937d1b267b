"""3D Gaussians with view-dependent colours (Kerbl et al. 2023), as every part of fprf passes them.

World axes are the capture's own. Colour seen along a unit direction d = max(0, 0.5 + sum_k Y_k(d) harmonics_k), sRGB, with
the real spherical harmonics Y of `fields.harmonics`.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import DataError
from ..ops.harmonics import HARMONIC

COUNTS = (1, 4, 9, 16, 25)
"""Harmonics a channel, by degree."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians, float32, on one device. K = (degree + 1)^2 harmonics a channel, the constant one first."""

    means: Annotated[Tensor, "N 3"]
    quaternions: Annotated[Tensor, "N 4"]
    """Own axes to world, w x y z, of any length above 0."""
    log_scales: Annotated[Tensor, "N 3"]
    """Natural logarithms of the standard deviations along the own axes."""
    logits: Annotated[Tensor, "N"]
    """Opacities before the sigmoid."""
    harmonics: Annotated[Tensor, "N K 3"]

    def __post_init__(self) -> None:
        n, k = len(self.means), self.harmonics.shape[1] if self.harmonics.ndim == 3 else 0
        wanted = {"means": (n, 3), "quaternions": (n, 4), "log_scales": (n, 3), "logits": (n,), "harmonics": (n, k, 3)}
        for name, shape in wanted.items():
            if tuple(getattr(self, name).shape) != shape:
                raise DataError(f"Gaussians: {name} of shape {tuple(getattr(self, name).shape)}; expected {shape}")
        if k not in COUNTS:
            raise DataError(f"Gaussians: {k} harmonics a channel; there are 1, 4, 9, 16 or 25, for degrees 0 to 4")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 4."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @property
    def opacities(self) -> Annotated[Tensor, "N"]:
        """In [0, 1]."""
        return torch.sigmoid(self.logits)

    @property
    def colours(self) -> Annotated[Tensor, "N 3"]:
        """Mean colours over all directions; may leave [0, 1]."""
        return 0.5 + HARMONIC * self.harmonics[:, 0]

    @property
    def finite(self) -> Annotated[Tensor, "N"]:
        """Gaussians that can be drawn: every number finite, but for infinite logits, which are opacities 0 and 1; bool."""
        parts = (self.means, self.quaternions, self.log_scales, self.harmonics.flatten(1))
        return torch.stack([part.isfinite().all(1) for part in parts]).all(0) & ~self.logits.isnan()

    def recoloured(self, harmonics: Annotated[Tensor, "N K 3"]) -> "Gaussians":
        """The same Gaussians with other harmonics."""
        return replace(self, harmonics=harmonics)

    def select(self, index: Annotated[Tensor, "M"] | slice) -> "Gaussians":
        """Some of the Gaussians, in the order of `index` (int64, or a mask of all); without a copy those of a slice."""
        return Gaussians(*(part[index] for part in vars(self).values()))


def from_arrays(
    means: NDArray[Any], quaternions: NDArray[Any], log_scales: NDArray[Any], logits: NDArray[Any], harmonics: NDArray[Any]
) -> Gaussians:
    """Gaussians of arrays of any float type; what is beyond float32 becomes infinite."""
    parts = (means, quaternions, log_scales, logits, harmonics)
    return Gaussians(*(torch.from_numpy(np.array(part, np.float32, order="C")) for part in parts))


def morton_order(cells: Annotated[NDArray[np.int64], "N 3"]) -> NDArray[np.int64]:
    """Indices along a Morton curve (Z-order) of cells, 0 to 1023 a side: neighbours in space follow each other."""
    code = np.zeros(len(cells), np.int64)
    for axis in range(3):
        v = cells[:, axis]
        for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
            v = (v | v << shift) & mask
        code |= v << axis
    return np.argsort(code, kind="stable")
