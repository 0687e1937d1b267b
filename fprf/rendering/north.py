"""North in a scene: a level direction of its world, and how positions on the earth tell it.

N cameras. A place in the world, seen from above, is the complex number z = right + i ahead; a place on the earth is
g = east + i north, in metres. A scene that is level is turned, scaled and shifted against the earth: g = a z + c, and
north is where a z points to i. Errors of positions of the same deviation s east and north turn a by s / (|a| d)
radians, d^2 the sum of squares of |z| about their mean; errors that drift from one end of the cameras to the other by a
few metres turn it by these over the extent.
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from .cameras import Cameras

MAX_UNCERTAINTY_DEGREES = 10.0
"""Standard deviation of a direction that counts as north, at most."""
MIN_FIXES = 4
"""Positions that tell north, at least: three leave no error to judge them by."""
USUAL_ACCURACY_METRES = 3.0
"""Deviation of positions of phones and drones in the open, at least. By as much their errors differ from one end of a
walk to the other: what of that is in proportion to the way hides in the fit. A street of 200 m by a phone: its halves, of
60 and 106 m, are turned by 2.5 degrees either way.
"""
_MIN_LEVEL_PART = 0.3
"""Level part of a direction of north, at least: of less nothing is left once it is made level (by eye)."""
_MIN_INDEPENDENT_FIXES = 2.0
"""Positions whose errors are independent, at least, however alike those of neighbours are."""
_MIN_KEPT_SHARE = 0.6
"""Of the positions that must agree with one another (by eye)."""
_MAX_DEVIATIONS = 4.0
"""Distance of a position from where it should be, in deviations, from which on it is left out."""
_TRIED_PAIRS = 300
"""Pairs of positions that a first direction is taken from: of half wrong ones a quarter of the pairs is right."""
_MAX_ROUNDS = 20
"""Rounds of leaving out: they end when none is left out anew, mostly after three."""
_MEDIAN_OF_RAYLEIGH = 1.1774
"""Median distance of points whose deviation is 1 along each of two axes."""
_WGS84_RADIUS_METRES = 6_378_137.0
"""At the equator."""
_WGS84_ECCENTRICITY_SQUARED = 0.00669438
"""Of the earth's ellipsoid."""


@dataclass(frozen=True, kw_only=True)
class North:
    """Direction of north in a scene, and its source."""

    direction: tuple[float, float, float]
    """Of length 1, in the axes of the scene's world."""
    source: str = ""
    """A phrase that says from what it is known."""
    southern: bool | None = None
    """The scene lies south of the equator; None = not known."""


class Bearings(NamedTuple):
    """Directions of north and up in the world of a file of Gaussians."""

    north: tuple[float, float, float]
    up: tuple[float, float, float] | None
    """None = not known."""


class NorthFit(NamedTuple):
    """North as positions on the earth tell it."""

    direction: Annotated[Tensor, "3"]
    """Of length 1, level, float64."""
    uncertainty: float
    """Standard deviation in degrees; infinite where the positions agree on none."""
    kept: int
    """Positions that agree."""
    extent: float
    """Of these in metres."""


def world_axes(
    cameras: Cameras, known: tuple[float, float, float] | None = None
) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
    """Up, where it is not known as cameras are held level, and the level direction of the first view; both of length 1."""
    up = _held_level(cameras) if known is None else torch.tensor(known).double()
    ahead = (cameras.pose[0, :, 1] - cameras.pose[0, :, 2]).double()
    ahead = torch.nn.functional.normalize(ahead - (ahead @ up) * up, dim=0)
    return up.float(), ahead.float()


def _held_level(cameras: Cameras) -> Annotated[Tensor, "3"]:
    """Up as cameras are held level; of length 1."""
    right = cameras.pose[:, :, 0].double()
    # All have their x axes square to it; of views in one direction their own y axes tell it.
    above = (cameras.pose[:, :, 1] + 0.5 * cameras.pose[:, :, 2]).double().mean(0)
    moments = right.T @ right / len(right) - 1e-4 * torch.outer(above, above)
    up: Tensor = torch.linalg.eigh(moments)[1][:, 0]
    return up if float(up @ above) >= 0 else -up


def bearings_of(
    cameras: Cameras, north: North | None, up: tuple[float, float, float] | None
) -> Bearings | None:
    """Bearings of a scene that cameras see, with its direction up where that is known; None where nothing tells its
    north.
    """
    if north is None:
        return None
    x, y, z = world_axes(cameras, up)[0].tolist()
    return Bearings(north.direction, (x, y, z))


def level_direction(
    direction: Annotated[Tensor, "3"], up: Annotated[Tensor, "3"]
) -> Annotated[Tensor, "3"] | None:
    """The level direction of length 1 of another; None where that points up or down. `up` is of length 1."""
    level = direction - (direction @ up) * up
    if float(level.norm()) < _MIN_LEVEL_PART:
        return None
    return torch.nn.functional.normalize(level, dim=0)


def metres_from(
    latitude: Annotated[Tensor, "N"], longitude: Annotated[Tensor, "N"]
) -> Annotated[Tensor, "N 2"]:
    """Metres east and north of the first of some positions in degrees, which lie near to one another; float64."""
    middle = math.radians(float(latitude.median()))
    shape = 1 - _WGS84_ECCENTRICITY_SQUARED * math.sin(middle) ** 2
    across = _WGS84_RADIUS_METRES / math.sqrt(shape)
    along = across * (1 - _WGS84_ECCENTRICITY_SQUARED) / shape
    # The shorter way round, also where the date changes.
    turn = (longitude - longitude[0] + 180) % 360 - 180
    east = torch.deg2rad(turn) * across * math.cos(middle)
    return torch.stack([east, torch.deg2rad(latitude - latitude[0]) * along], 1).double()


def fit_north(
    places: Annotated[Tensor, "N 3"],
    metres: Annotated[Tensor, "N 2"],
    up: Annotated[Tensor, "3"],
    accuracy: float = USUAL_ACCURACY_METRES,
) -> NorthFit:
    """North from at least `MIN_FIXES` places in a world, in the order in which they were taken, and where they are, in
    metres east and north; some may be wrong. `accuracy` is their deviation in metres, at least.
    """
    up = torch.nn.functional.normalize(up.double(), dim=0)
    right, ahead = _level_basis(up)
    places = places.double() - places.double().mean(0)
    seen = torch.complex(places @ right, places @ ahead)
    known = torch.complex(metres[:, 0].double(), metres[:, 1].double())
    turn, shift = _first_fit(seen, known)
    kept = torch.ones(len(seen), dtype=torch.bool)
    for _ in range(_MAX_ROUNDS):
        error = (known - turn * seen - shift).abs()
        deviation = max(float(error.median()) / _MEDIAN_OF_RAYLEIGH, accuracy)
        agrees = error < _MAX_DEVIATIONS * deviation
        if bool((agrees == kept).all()) or int(agrees.sum()) < MIN_FIXES:
            break
        kept = agrees
        turn, shift = _least_squares(seen[kept], known[kept])
    if bool(kept.all()):
        turn, shift = _least_squares(seen, known)
    count = int(kept.sum())
    around = turn.abs() * (seen[kept] - seen[kept].mean()).abs()
    error = (known - turn * seen - shift)[kept]
    extent = 2 * float(around.max())
    noise = float(error.abs().square().sum()) / max(2 * count - 4, 1)
    # Of errors smaller than expected nothing follows about how alike they are.
    independent = float(count) if noise < accuracy**2 else _independent(error)
    noise = max(noise, accuracy**2)
    spread = float(around.square().mean()) * independent
    uncertainty = math.inf
    if spread > 0 and count >= _MIN_KEPT_SHARE * len(seen):
        uncertainty = math.degrees(math.sqrt(noise / spread + (accuracy / extent) ** 2))
    # Where a z points to i.
    there = 1j * turn.conj() / turn.abs().clamp_min(1e-300)
    direction = there.real * right + there.imag * ahead
    return NorthFit(direction, uncertainty, count, extent)


def _independent(error: Annotated[Tensor, "N"]) -> float:
    """Number of independent errors that tell as much as these, of which neighbours may be alike."""
    count = len(error)
    power = float(error.abs().square().sum())
    alike = 0.0
    if power > 0:
        alike = float((error[1:] * error[:-1].conj()).real.sum()) / power
    # Chance makes neighbours that are not alike so much alike.
    if alike < 2 / math.sqrt(2 * count):
        alike = 0.0
    independent = count * (1 - alike) / (1 + alike)
    return max(independent, _MIN_INDEPENDENT_FIXES)


def _level_basis(up: Annotated[Tensor, "3"]) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
    """Two level directions of length 1, the first to the right of the second."""
    axis = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
    ahead = torch.nn.functional.normalize(axis - (axis @ up) * up, dim=0)
    return torch.linalg.cross(ahead, up), ahead


def _first_fit(seen: Annotated[Tensor, "N"], known: Annotated[Tensor, "N"]) -> tuple[Tensor, Tensor]:
    """a and c of the pair of positions from which half of all are least far."""
    draw = torch.Generator().manual_seed(0)
    pairs = torch.randint(len(seen), (2, _TRIED_PAIRS), generator=draw)
    apart = seen[pairs[1]] - seen[pairs[0]]
    usable = apart.abs() > 0
    if not bool(usable.any()):
        return torch.zeros((), dtype=seen.dtype), known.mean()
    pairs = pairs[:, usable]
    turns = (known[pairs[1]] - known[pairs[0]]) / apart[usable]
    moved = known - turns[:, None] * seen
    shifts = torch.complex(moved.real.median(1).values, moved.imag.median(1).values)
    best = (moved - shifts[:, None]).abs().median(1).values.argmin()
    return turns[best], shifts[best]


def _least_squares(seen: Annotated[Tensor, "N"], known: Annotated[Tensor, "N"]) -> tuple[Tensor, Tensor]:
    """a and c of all."""
    around = seen - seen.mean()
    turn = (around.conj() * (known - known.mean())).sum() / around.abs().square().sum().clamp_min(1e-300)
    return turn, known.mean() - turn * seen.mean()
