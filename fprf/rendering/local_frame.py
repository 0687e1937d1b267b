"""The local frame: coordinates about an origin near the scene, so that float32 holds them.

world = local + origin, in float64, axes and unit the same. Projected metres (UTM) reach 6e6, Earth-centred
ones too: there float32 steps by half a metre. The origin is 0 for scenes that lie near it, whole numbers for
scenes of more than a unit, and always so short a binary number that taking it off loses nothing.

Formats of float32 hold local coordinates, with a file beside them that says what to add (a "global shift"):
NAME.offset.json for a file NAME, {"offset": [x, y, z]}.
"""

import math
from pathlib import Path
from typing import Annotated

from torch import Tensor

from ..errors import DataError
from ..io.atomic import write_json
from ..io.strict_json import parse_json
from ..types import Origin

_MAX_EXTENTS = 16.0
"""Distance from 0, in extents, up to which the origin is 0: float32 then resolves 1e-6 of the extent."""
_MAX_SAMPLED_PLACES = 1 << 16
"""Places that are looked at, about; by eye."""


def local_origin(place: Annotated[Tensor, "N 3"], around: Annotated[Tensor, "P 3"] | None = None) -> Origin:
    """Origin of places and of what is `around` them, to a power of two below their extent; 0 unless they lie
    far from 0.

    The extent is that of the places, or the distance that half of what is around keeps, if that is more.
    """
    middle, extent = extent_of(place)
    if around is not None and len(around := _some(around)):
        extent = max(extent, float((around - middle).norm(dim=1).median()))
    if not 0 < _MAX_EXTENTS * extent < float(middle.norm()):
        return (0.0, 0.0, 0.0)
    step = 2.0 ** math.floor(math.log2(extent))
    x, y, z = ((middle / step).round() * step + 0.0).tolist()  # + 0.0: no negative zero
    return x, y, z


def extent_of(place: Annotated[Tensor, "N 3"]) -> tuple[Annotated[Tensor, "3"], float]:
    """The median of places, and the distance from it that nine in ten keep; of finite ones, float64. 0 where
    there are none.
    """
    place = _some(place)
    if not len(place):
        return place.new_zeros(3), 0.0
    middle = place.median(0).values
    return middle, float((place - middle).norm(dim=1).quantile(0.9))


def _some(place: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "M 3"]:
    """Finite places at equal steps, float64."""
    place = place[:: max(1, len(place) // _MAX_SAMPLED_PLACES)].double()
    return place[place.isfinite().all(1)]


def added_and_beside(origin: Origin, local: bool) -> tuple[Origin, Origin]:
    """The offset that is added to local coordinates in a file of float64, and the one that its offset file
    says.
    """
    none = (0.0, 0.0, 0.0)
    return (none, origin) if local else (origin, none)


def offset_file(path: Path) -> Path:
    """The file that says what to add to the coordinates of a file."""
    return path.with_name(f"{path.name}.offset.json")


def write_offset(path: Path, offset: Origin) -> None:
    """Write the offset file of a file; remove that of a file before where nothing is to be added."""
    if any(offset):
        write_json(offset_file(path), {"offset": list(offset)})
    else:
        offset_file(path).unlink(missing_ok=True)


def read_offset(path: Path) -> Origin:
    """The offset of the coordinates of a file; 0 without an offset file. Raises DataError."""
    file = offset_file(path)
    if not file.is_file():
        return (0.0, 0.0, 0.0)
    try:
        x, y, z = (float(value) for value in parse_json(file.read_text("utf-8"))["offset"])
        if not all(map(math.isfinite, (x, y, z))):
            raise ValueError(f"{x} {y} {z}")
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DataError(
            f'{file}: not {{"offset": [x, y, z]}} with three numbers ({error}); correct or remove it'
        ) from error
    return x, y, z
