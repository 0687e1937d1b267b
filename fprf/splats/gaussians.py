"""3D Gaussians with view-dependent colours (Kerbl et al. 2023), as every part of fprf passes them.

World axes are the capture's own. Colour seen along a unit direction d = max(0, 0.5 + sum_k Y_k(d)
harmonics_k), sRGB, with the real spherical harmonics Y of `ops.harmonics`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import CheckpointError, DataError
from ..ops.harmonics import HARMONIC
from ..ops.rasterise.training import HARMONICS, LOG_SCALES, LOGIT, MEANS, QUATERNION
from ..rendering.north import Bearings

COUNTS = (1, 4, 9, 16, 25)
"""Harmonics a channel, by degree."""
_MAX_DRAWN_MAGNITUDE = 1e15
"""Magnitude from which on nothing is drawn (`ops.rasterise.reference`)."""
_MAX_LOG_SCALE = 88.0
"""Largest ln-scale whose size is finite in float32: exp(88.7) is its largest number."""
_MIN_LOG_SCALE = -30.0
"""Smallest ln-scale that drawing tells from 0 (`ops.rasterise.reference`)."""
_MIN_QUATERNION = 1e-12
"""Magnitude of a quaternion's largest component below which there is no rotation: its square, in float32, is
far above 0.
"""
_CHECKED_ROWS = 1 << 20
"""Gaussians whose magnitudes are taken together: those of all would take as much memory as these."""
_MAX_BULK_POINTS = 100_000
"""Points, about, of which the bulk is found; by eye: percentiles of so many are good to a tenth of one."""
MAX_BULK_DISTANCE = 128.0
"""Distance from the bulk (`Bulk.apart`) beyond which Gaussians are stray; by eye."""


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
        n = len(self.means)
        if self.harmonics.ndim == 3:
            k = self.harmonics.shape[1]
        else:
            k = 0
        wanted = {
            "means": (n, 3),
            "quaternions": (n, 4),
            "log_scales": (n, 3),
            "logits": (n,),
            "harmonics": (n, k, 3),
        }
        for name, shape in wanted.items():
            if tuple(getattr(self, name).shape) != shape:
                raise DataError(
                    f"Gaussians: {name} of shape {tuple(getattr(self, name).shape)}; expected {shape}"
                )
        if k not in COUNTS:
            raise DataError(
                f"Gaussians: {k} harmonics a channel; there are 1, 4, 9, 16 or 25, for degrees 0 to 4"
            )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 4."""
        return math.isqrt(self.harmonics.shape[1]) - 1

    @property
    def opacities(self) -> Annotated[Tensor, "N"]:
        """Opacities in [0, 1]."""
        return torch.sigmoid(self.logits)

    @property
    def colours(self) -> Annotated[Tensor, "N 3"]:
        """Mean colours over all directions; may leave [0, 1]."""
        return 0.5 + HARMONIC * self.harmonics[:, 0]

    @property
    def rows(self) -> Annotated[Tensor, "N R"]:
        """All parameters of a Gaussian in a row of R = 11 + 3 K, in the columns of
        `ops.rasterise.training`.
        """
        parts = (self.means, self.log_scales, self.quaternions, self.logits[:, None])
        return torch.cat([*parts, self.harmonics.flatten(1)], 1)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All parameters by their names."""
        found: dict[str, Tensor] = {}
        for field in fields(self):
            found[field.name] = getattr(self, field.name)
        return found

    @property
    def finite(self) -> Annotated[Tensor, "N"]:
        """Gaussians that can be drawn, bool: with finite numbers below 1e15 and rotations of a length above
        0.

        Infinite logits are opacities 0 and 1, and ln-scales of -inf those of flat Gaussians: both can be
        drawn.
        """
        bounded, turned = self._sound()
        return bounded & turned

    def _sound(self) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N"]]:
        """Masks of the Gaussians whose numbers are within bounds, and of those that have a rotation."""
        parts = (self.means, self.quaternions, self.harmonics.flatten(1))
        bounded = (self.log_scales <= _MAX_LOG_SCALE).all(1) & ~self.logits.isnan()  # False for NaN
        for part in parts:
            small = []
            for rows in torch.split(part, _CHECKED_ROWS):
                small.append((rows.abs() < _MAX_DRAWN_MAGNITUDE).all(1))
            bounded = bounded & torch.cat(small)
        return bounded, (self.quaternions.abs() >= _MIN_QUATERNION).any(1)

    def faults(self) -> list[str]:
        """Counts of Gaussians that cannot be drawn, for each reason: "3 that are not finite"."""
        bounded, turned = self._sound()
        counts = {"that are not finite": ~bounded, "without a rotation": bounded & ~turned}
        found: list[str] = []
        for what, each in counts.items():
            if bool(each.any()):
                found.append(f"{int(each.sum())} {what}")
        return found

    def drawable(self) -> "Gaussians":
        """The Gaussians that can be drawn, with finite ln-scales: flat ones get the smallest that makes a
        difference.
        """
        finite = self.finite
        kept = self if bool(finite.all()) else self.select(finite)
        return replace(kept, log_scales=kept.log_scales.clamp_min(_MIN_LOG_SCALE))

    def recoloured(self, harmonics: Annotated[Tensor, "N K 3"]) -> "Gaussians":
        """The same Gaussians with other harmonics."""
        return replace(self, harmonics=harmonics)

    def to(self, device: torch.device) -> "Gaussians":
        """The same Gaussians on a device."""
        return Gaussians(**{name: part.to(device) for name, part in self.tensors.items()})

    def select(self, index: Annotated[Tensor, "M"] | slice) -> "Gaussians":
        """Some of the Gaussians, in the order of `index` (int64, or a mask of all); without a copy those of a
        slice.
        """
        return Gaussians(**{name: part[index] for name, part in self.tensors.items()})


@dataclass(frozen=True, eq=False)
class GaussianRows:
    """Gaussians of which some rows at a time are in memory."""

    count: int
    part: Callable[[slice], Gaussians]
    antialiased: bool
    """Opacities are compensated for the width that drawing adds (Mip-Splatting)."""
    bearings: Bearings | None = None
    """Directions of north and up, for a file to say; None if nothing tells them."""


def from_arrays(
    means: NDArray[Any],
    quaternions: NDArray[Any],
    log_scales: NDArray[Any],
    logits: NDArray[Any],
    harmonics: NDArray[Any],
) -> Gaussians:
    """Gaussians of arrays of any float type; what is beyond float32 becomes infinite."""
    parts = (means, quaternions, log_scales, logits, harmonics)
    return Gaussians(*(torch.from_numpy(np.require(part, np.float32, ["C", "W"])) for part in parts))


def from_rows(rows: Annotated[Tensor, "N R"]) -> Gaussians:
    """The Gaussians of `Gaussians.rows`."""
    harmonics = rows[:, HARMONICS].reshape(len(rows), (rows.shape[1] - HARMONICS.start) // 3, 3)
    parts = (rows[:, MEANS], rows[:, QUATERNION], rows[:, LOG_SCALES], rows[:, LOGIT.start], harmonics)
    return Gaussians(*(part.contiguous() for part in parts))


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of some, one after the other."""
    tensors = {}
    for field in fields(Gaussians):
        rows = []
        for part in parts:
            rows.append(getattr(part, field.name))
        tensors[field.name] = torch.cat(rows)
    return Gaussians(**tensors)


def tensors_of(gaussians: Gaussians, near: float) -> dict[str, Tensor]:
    """The tensors of a checkpoint; nothing nearer to a camera than `near` is drawn."""
    return gaussians.tensors | {"near": torch.tensor(near, dtype=torch.float64)}


def from_tensors(tensors: Mapping[str, Tensor]) -> Gaussians:
    """The Gaussians of a checkpoint. Raises CheckpointError where it holds none."""
    try:
        return Gaussians(**{field.name: tensors[field.name] for field in fields(Gaussians)})
    except KeyError as error:
        raise CheckpointError(f"the checkpoint holds no {error}, so it is not of Gaussians") from error


class Bulk(NamedTuple):
    """Place of most of N points, and distances of the others."""

    side: float
    """Longest side of the box of the middle 80 % along each axis; of all points where that has none."""
    apart: Annotated[NDArray[np.float64], "N"]
    """Distance of each point from that box, the largest along an axis, in `side`; 0 within."""
    low: Annotated[NDArray[np.float64], "3"]
    """Lowest corner of that box."""
    high: Annotated[NDArray[np.float64], "3"]
    """Highest corner."""

    def distances(self, points: Annotated[NDArray[Any], "M 3"]) -> Annotated[NDArray[np.float64], "M"]:
        """Distances of other points, as `apart` has them."""
        return _apart(points, self.low, self.high, self.side)


def bulk_of(points: Annotated[NDArray[Any], "N 3"]) -> Bulk:
    """The bulk of finite points. Up to a tenth of them may lie anywhere on either side without moving it."""
    if not len(points):
        return Bulk(0.0, np.zeros(0), np.zeros(3), np.zeros(3))
    # Of many points a sample says where the middle is.
    some = points[:: max(1, len(points) // _MAX_BULK_POINTS)].astype(np.float64)
    low, high = np.percentile(some, (10, 90), axis=0)
    side = float((high - low).max()) or float(np.ptp(points.astype(np.float64), axis=0).max())
    return Bulk(side, _apart(points, low, high, side), low, high)


def _apart(
    points: Annotated[NDArray[Any], "M 3"],
    low: Annotated[NDArray[np.float64], "3"],
    high: Annotated[NDArray[np.float64], "3"],
    side: float,
) -> Annotated[NDArray[np.float64], "M"]:
    apart: NDArray[np.float64] = np.maximum(low - points, points - high).max(1).clip(0)
    return apart / (side or 1.0)


def cells_of(
    places: Annotated[Tensor, "N 3"], low: Annotated[Tensor, "3"], edge: float
) -> Annotated[Tensor, "N"]:
    """Numbers of cells that begin at `low`; places far outside share those at the border."""
    cell: Tensor = ((places - low) / edge).clamp(-1, 2.0**20).long() + 1
    return (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]


def morton_order(cells: Annotated[NDArray[np.int64], "N 3"]) -> NDArray[np.int64]:
    """Indices along a Morton curve (Z-order) of cells, 0 to 1023 a side: neighbours in space follow each
    other.
    """
    # Bits of the three coordinates interleaved: each coordinate's are spread to every third place by doubling
    # the gaps.
    code = np.zeros(len(cells), np.int64)
    for axis in range(3):
        v = cells[:, axis]
        for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3), (2, 0x9249249)):
            v = (v | v << shift) & mask
        code |= v << axis
    return np.argsort(code, kind="stable")
