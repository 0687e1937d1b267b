"""Positions of photographs on the earth, as cameras and phones write them into EXIF, and north as they tell it.

A file names degrees, minutes and seconds, and by a letter the hemisphere. Compass directions (GPSImgDirection) are not
read: of 29 photographs of a street by a phone 20 were off by 157 degrees and 9 by 9, where its positions tell north
within 1.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from PIL.ExifTags import GPS, IFD
from torch import Tensor

from ..rendering.north import (
    MAX_UNCERTAINTY_DEGREES,
    MIN_FIXES,
    USUAL_ACCURACY_METRES,
    North,
    fit_north,
    metres_from,
    world_axes,
)
from .image_files import exif_of
from .scene import ParsedScene

_MAX_READ_FILES = 400
"""Photographs whose positions are read, evenly through a scene: more tell no more, and take a millisecond each."""
_FIRST_FILES = 8
"""Photographs that are read first: where none of them has a position, the others have none."""
_MAX_SAID_DEGREES = 45.0
"""Uncertainty that is said as a number: more is any angle."""
NORTH_NOTE = "north: "
"""Begin of the note of a scene about north."""


class Position(NamedTuple):
    """Degrees north of the equator and east of Greenwich."""

    latitude: float
    longitude: float
    accuracy: float = 0.0
    """Metres, as the receiver says; 0 where it does not."""


def read_position(path: Path) -> Position | None:
    """Position of a photograph by its EXIF block; None if that says nothing, or nothing sound."""
    try:
        with path.open("rb") as file:
            block = exif_of(file, path).get_ifd(IFD.GPSInfo)
        latitude = _degrees(block[GPS.GPSLatitude], block[GPS.GPSLatitudeRef], "NS")
        longitude = _degrees(block[GPS.GPSLongitude], block[GPS.GPSLongitudeRef], "EW")
        accuracy = float(block.get(GPS.GPSHPositioningError, 0.0))
    except Exception:  # values of other types, and whatever Pillow raises over a damaged block
        return None
    # A receiver without satellites writes zeros.
    if not (abs(latitude) < 90 and abs(longitude) <= 180) or (latitude == 0 and longitude == 0):
        return None
    return Position(latitude, longitude, accuracy if 0 < accuracy < math.inf else 0.0)


def _degrees(parts: Sequence[object], letter: object, letters: str) -> float:
    """Degrees, minutes and seconds as degrees. Raises ValueError for a letter that is none of the two."""
    if isinstance(letter, bytes):
        letter = letter.decode()
    side = [*letters].index(str(letter).strip("\0 ").upper())
    total = 0.0
    for part, unit in zip(parts, (1, 60, 3600), strict=True):
        total += float(part) / unit  # type: ignore[arg-type]
    return -total if side else total


def with_north(scene: ParsedScene) -> ParsedScene:
    """The scene with north, and a note: as the capture says it, else as the positions of its photographs tell it; as it
    is where they have none.
    """
    if scene.north is not None:
        return _noted(scene, scene.north.source)
    placed = read_positions(scene.paths)
    if not placed:
        return scene
    views = [*placed]
    up, _ = world_axes(scene.cameras, scene.up)
    found = north_of(scene.cameras.pose[views, :, 3], [*placed.values()], up)
    if isinstance(found, str):
        return _noted(scene, f"not known: {found}")
    return _noted(replace(scene, north=found), found.source)


def north_of(
    places: Annotated[Tensor, "N 3"], positions: Sequence[Position], up: Annotated[Tensor, "3"]
) -> North | str:
    """North from places of cameras in a world and their positions, in the order in which they were taken; where that is
    too uncertain, the reason.
    """
    count = len(positions)
    if count < MIN_FIXES:
        return f"{count} of the photographs have a position (GPS), {MIN_FIXES} at least tell it"
    found = torch.tensor(positions, dtype=torch.float64)
    accuracy = max(USUAL_ACCURACY_METRES, float(found[:, 2].median()))
    fit = fit_north(places, metres_from(found[:, 0], found[:, 1]), up, accuracy)
    by = f"positions (GPS) of {fit.kept} photographs"
    if math.isinf(fit.uncertainty) and fit.extent > 0:
        return f"{by} of {count} agree with the cameras' places, all others contradict"
    if fit.uncertainty > MAX_UNCERTAINTY_DEGREES:
        turn = f"{fit.uncertainty:.0f} degrees" if fit.uncertainty < _MAX_SAID_DEGREES else "any angle"
        return f"{by} over {fit.extent:.0f} m leave it uncertain by {turn}, {MAX_UNCERTAINTY_DEGREES:g} at most count"
    x, y, z = fit.direction.tolist()
    near = max(1, round(fit.uncertainty))
    unit = "degree" if near == 1 else "degrees"
    southern = float(found[:, 0].median()) < 0
    return North(direction=(x, y, z), source=f"{by}, give or take {near} {unit}", southern=southern)


def read_positions(paths: Sequence[Path]) -> dict[int, Position]:
    """Positions by view; none where none of the first few that are read has one."""
    views = [*range(0, len(paths), -(-len(paths) // _MAX_READ_FILES))]
    first = views[:: -(-len(views) // _FIRST_FILES)]
    placed = _positions(paths, first)
    if placed:
        placed = _positions(paths, views)
    return placed


def _positions(paths: Sequence[Path], views: Sequence[int]) -> dict[int, Position]:
    placed = {}
    for view in views:
        position = read_position(paths[view])
        if position is not None:
            placed[view] = position
    return placed


def _noted(scene: ParsedScene, text: str) -> ParsedScene:
    return replace(scene, notes=(*scene.notes, f"{NORTH_NOTE}{text}"))
