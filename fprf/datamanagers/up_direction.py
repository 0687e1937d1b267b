"""Direction up of a capture whose photographs all look one way and are held alike: a flight straight down, or a wall.

Elsewhere the cameras' x axes, which are level, span the horizon (`rendering.north.world_axes`). Here they are one line, and
cameras that look at a wall and cameras that look down differ by a quarter turn of the world alone. In this order it is told
by what a file says, by gimbal angles that DJI's drones write into photographs, by positions (GPS), which move with cameras
that look down and not with those that climb a wall, and by how far cameras move over what they see.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import DataError
from ..rendering.cameras import Cameras
from ..rendering.north import MIN_FIXES, USUAL_ACCURACY_METRES, metres_from, world_axes
from .image_files import open_image, opened
from .positions import read_positions
from .scene import ParsedScene

UP_NOTE = "up: "
"""Begin of the note of a scene about its direction up."""
_MIN_VIEWS = 4
"""Photographs that show that all are held alike."""
_MIN_PARALLEL = 0.95
"""Length of the mean of their directions, at least: eleven groups of one heading have 0.979 and more."""
_MAX_TURN_VARIANCE = 0.1
"""Second moment of x axes across their common line, at most: headings within 18 degrees (flights of one heading 0.002
to 0.06, all headings 0.3).
"""
_READ_PITCHES = 8
"""Photographs whose gimbal angle is read, evenly through a scene."""
_DOWN_PITCH = -60.0
"""Degrees of a camera over the horizon, at most, that looks down: oblique flights have -45 and more."""
_MIN_SPREAD_METRES = 3 * USUAL_ACCURACY_METRES
"""RMS distance of cameras from their middle across both axes, at least, for positions to tell a level plane."""
_MIN_LEVEL_RATIO = 0.7
"""Of the widths of the cameras' plane seen from above over its own, from which on it is level: it leans by 46 degrees."""
_MAX_UPRIGHT_RATIO = 0.4
"""The same up to which it stands: it leans by 66 degrees."""
_MIN_TRAVEL = 0.35
"""RMS extent of cameras over the shorter side of what one sees, at least, along one axis: flights have 0.4 to 0.8,
forward-facing captures (LLFF) 0.05 to 0.12.
"""
_MIN_SIDE_TRAVEL = 0.15
"""The same across it: flights in strips have 0.25 to 0.5, a walk along a wall 0.04."""
_MAX_DEPTH_TRAVEL = 0.5
"""RMS extent along the view over that across it, at most: those that move ahead are no flights over a plane."""
_MAX_FLATNESS = 0.1
"""Third extent of cameras over the second, at most, for their plane to tell up: the flight keeps its height."""
_MAX_TILT_DEGREES = 15.0
"""Between the normal of that plane and the mean view, at most: more is a climb."""
_MAX_CONFIRMED_DEGREES = 10.0
"""Between the view and up as cameras are held level: no closer is told by views of a flight that is not stabilised."""
_SEEN_POINTS = 2000
"""Points that tell how far away things are."""
_SEEN_VIEWS = 24
"""Views that tell it."""


class _Alike(NamedTuple):
    """Cameras that all look one way, in the axes of their mean: x right, y up, z back."""

    axes: Annotated[Tensor, "3 3"]
    """These axes as columns, in the world."""
    places: Annotated[Tensor, "V 3"]
    """About their middle."""


def with_up(scene: ParsedScene, asked: tuple[float, float, float] | None = None) -> ParsedScene:
    """The scene with its direction up, as asked or as the capture says it, else where its cameras look down; as it is
    where they are held level, and with a note where they are held alike and it is a guess.

    Raises DataError for what is no direction.
    """
    if asked is not None:
        up = torch.tensor(asked, dtype=torch.float64)
        if not bool(up.isfinite().all()) or float(up.norm()) == 0:
            raise DataError(f"up {asked}: no direction; give three numbers, not all 0")
        return _with(scene, up)
    if scene.up is not None:
        return scene
    alike = _held_alike(scene.cameras)
    if alike is None:
        return scene
    for told in (_by_gimbal(scene.paths), _by_positions(scene, alike)):
        if told is not None:
            down, reason = told
            return _noted(_with(scene, _against_view(scene.cameras, alike)), reason) if down else scene
    travel = _travel(scene, alike)
    if travel is None or travel.most < _MIN_TRAVEL:
        return scene
    if travel.least >= _MIN_SIDE_TRAVEL:
        found = _with(scene, _against_view(scene.cameras, alike))
        return _noted(
            found,
            "against the view, as all cameras look one way and pass over what they see (--up says otherwise)",
        )
    return _noted(
        scene,
        "as cameras are held level; they pass along what they see, and if that is the ground, --up says so",
    )


def _with(scene: ParsedScene, up: Annotated[Tensor, "3"]) -> ParsedScene:
    x, y, z = torch.nn.functional.normalize(up, dim=0).tolist()
    return replace(scene, up=(x, y, z))


def _noted(scene: ParsedScene, text: str) -> ParsedScene:
    return replace(scene, notes=(*scene.notes, f"{UP_NOTE}{text}"))


def _held_alike(cameras: Cameras) -> _Alike | None:
    """The cameras in the axes of their mean; None where they look or are turned in several directions."""
    pose = cameras.pose.double()
    back = pose[:, :, 2].mean(0)
    if len(pose) < _MIN_VIEWS or float(back.norm()) < _MIN_PARALLEL:
        return None
    right = pose[:, :, 0]
    variance, lines = torch.linalg.eigh(right.T @ right / len(right))
    if float(variance[1]) > _MAX_TURN_VARIANCE:
        return None
    back = torch.nn.functional.normalize(back, dim=0)
    # Strips are flown to and fro: x axes are of either sign.
    across = lines[:, 2] - (lines[:, 2] @ back) * back
    across = torch.nn.functional.normalize(across, dim=0)
    places = pose[:, :, 3] - pose[:, :, 3].mean(0)
    return _Alike(torch.stack([across, torch.linalg.cross(back, across), back], 1), places)


def _against_view(cameras: Cameras, alike: _Alike) -> Annotated[Tensor, "3"]:
    """Up of cameras that look down: across their plane, if they keep to one, else against their mean view."""
    back = alike.axes[:, 2]
    _, extents, rows = torch.linalg.svd(alike.places, full_matrices=True)
    normal: Tensor = rows[2] if float(rows[2] @ back) > 0 else -rows[2]
    tilt = math.degrees(math.acos(min(1.0, float(normal @ back))))
    if (
        len(extents) == 3
        and float(extents[2]) < _MAX_FLATNESS * float(extents[1])
        and tilt < _MAX_TILT_DEGREES
    ):
        return normal
    held = world_axes(cameras)[0].double()
    if float(held @ back) > math.cos(math.radians(_MAX_CONFIRMED_DEGREES)):
        return held
    return back


def _by_gimbal(paths: Sequence[Path]) -> tuple[bool, str] | None:
    """True with a reason if cameras look down as their gimbals say; None where they say nothing."""
    found = []
    for path in paths[:: max(1, -(-len(paths) // _READ_PITCHES))]:
        pitch = read_pitch(path)
        if pitch is not None:
            found.append(pitch)
    if not found:
        return None
    middle = sorted(found)[len(found) // 2]
    return middle <= _DOWN_PITCH, f"against the view, as the gimbal looked {-middle:.0f} degrees down"


def read_pitch(path: Path) -> float | None:
    """Degrees of a photograph's view over the horizon, as DJI's drones write it; None for all others."""
    try:
        with opened(path) as file:
            block = open_image(file, path)[1].info.get("xmp", b"")
    except DataError:
        return None
    text = block.decode("latin-1") if isinstance(block, bytes) else str(block)
    said = re.search(r"GimbalPitchDegree(?:>|=\")\s*([-+]?[0-9]{1,3}(?:\.[0-9]+)?)", text)
    return None if said is None else float(said[1])


def _by_positions(scene: ParsedScene, alike: _Alike) -> tuple[bool, str] | None:
    """True with a reason if the plane that cameras are in is level by their positions, False if it stands; None where
    these are too few or too near to one another.

    Seen from above, a plane that leans by t is narrower by cos t: the singular values of the map from its axes to metres
    east and north.
    """
    placed = read_positions(scene.paths)
    if len(placed) < MIN_FIXES:
        return None
    views = [*placed]
    degrees = torch.tensor([[at.latitude, at.longitude] for at in placed.values()], dtype=torch.float64)
    metres = metres_from(degrees[:, 0], degrees[:, 1])
    plane = (alike.places @ alike.axes)[views, :2]
    flat = plane - plane.mean(0)
    # Wrong positions are left out twice.
    kept = torch.ones(len(views), dtype=torch.bool)
    widths = torch.zeros(2).double()
    for _ in range(3):
        here = flat[kept] - flat[kept].mean(0)
        there = metres[kept] - metres[kept].mean(0)
        solved = torch.linalg.lstsq(here, there).solution
        widths = torch.linalg.svdvals(solved)
        error = (metres - metres[kept].mean(0) - (flat - flat[kept].mean(0)) @ solved).norm(dim=1)
        kept = error <= 3 * error.median()
    spread = torch.linalg.svdvals(here)[1] / math.sqrt(len(here))
    if float(spread * widths[0]) < _MIN_SPREAD_METRES:
        return None
    ratio = float(widths[1] / widths[0])
    if ratio > _MIN_LEVEL_RATIO:
        return True, f"against the view, as positions (GPS) of {len(views)} photographs move with the cameras"
    return (False, "") if ratio < _MAX_UPRIGHT_RATIO else None


class _Travel(NamedTuple):
    """RMS extent of cameras across their view over the shorter side of what one of them sees."""

    most: float
    least: float
    """Square to that."""


def _travel(scene: ParsedScene, alike: _Alike) -> _Travel | None:
    """Travel of the cameras; None where no points say how far away things are, or where they move ahead."""
    if scene.points is None or not len(scene.points):
        return None
    cameras = scene.cameras.select(
        torch.arange(0, len(scene.cameras), max(1, len(scene.cameras) // _SEEN_VIEWS))
    )
    points = scene.points[:: max(1, len(scene.points) // _SEEN_POINTS)].double()
    pose = cameras.pose.double()
    x, y, z = ((points[None] - pose[:, None, :, 3]) @ pose[:, :, :3]).unbind(-1)
    reach = (cameras.size / cameras.focal / 2)[:, :, None]
    seen = (z < 0) & (x.abs() < -z * reach[:, 0]) & (y.abs() < -z * reach[:, 1])
    if not bool(seen.any()):
        return None
    side = float(-z[seen].median() * 2 * reach.amin(1).median())
    extents = torch.linalg.svdvals(alike.places @ alike.axes[:, :2]) / math.sqrt(len(alike.places))
    along = float((alike.places @ alike.axes[:, 2]).square().mean().sqrt())
    if along > _MAX_DEPTH_TRAVEL * float(extents[0]):
        return None
    return _Travel(float(extents[0]) / side, float(extents[1]) / side)
