"""Several captures in one world: neighbours as they lie, others each turned to one up and one north, in a row.

Files say where up and north are in their own axes (`Capture.up`, `Capture.north`), or their ground says up. A light falls
from one side of the joined world, so captures of different axes are turned until these agree.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..rendering.cameras import Cameras
from ..rendering.north import North, level_direction
from ..rendering.splines import quaternions, rotations
from .files import Capture
from .files.base import turned_harmonics
from .gaussians import Gaussians, bulk_of
from .ground import USUAL_UP, Direction, axis_name, find_ground

_ROW_GAP = 0.1
"""Distance between captures that would overlap, as a share of their width, where they are put in a row."""
_MIN_OVERLAP = 0.5
"""Of the sides of the smaller one of two boxes, from which on captures lie in one place: neighbours overlap
by less.
"""
_MAX_UP_DEGREES = 10.0
"""Between directions up of neighbours in one world (by eye): files agree far better, grounds are axes."""
_MAX_NORTH_DEGREES = 30.0
"""Between directions of north of neighbours in one world: each is uncertain by `MAX_UNCERTAINTY_DEGREES` at most."""
_SAME_DEGREES = 0.01
"""Between directions that are one: as files round them."""
_MAX_TURNED_BANDS = 16
"""Harmonics that can be turned, those of degree 3; more are left out of the sample that is looked at."""


@dataclass(frozen=True, kw_only=True)
class CaptureAxes:
    """Directions of one capture in its own axes."""

    path: Path
    up: Direction
    reason: str
    """Words for what the direction was found from."""
    said: bool = False
    """The file says it, or a flag."""
    told: bool = True
    """False: nothing tells it, and it is that of most captures."""
    north: North | None = None

    @property
    def note(self) -> str:
        """A line that says what points up."""
        return f"{self.path}: up is {axis_name(self.up)}: {self.reason} (--up says otherwise)"


class Placement(NamedTuple):
    """Place of a capture in the joined world: x there = turn x + move."""

    turn: Annotated[Tensor, "3 3"]
    """float64."""
    move: Annotated[Tensor, "3"]

    @property
    def turned(self) -> bool:
        """False where the axes are those of the joined world."""
        return not torch.equal(self.turn, torch.eye(3).double())

    def placed(self, part: Gaussians) -> Gaussians:
        """Gaussians of the capture in the joined world."""
        if not self.turned:
            return replace(part, means=part.means + self.move)
        turn = self.turn.to(part.means)
        kept = min(part.harmonics.shape[1], _MAX_TURNED_BANDS)
        matrix = torch.from_numpy(turned_harmonics(self.turn.numpy(), kept)).to(turn)
        harmonics = torch.zeros_like(part.harmonics)
        harmonics[:, :kept] = torch.einsum("kb,nbc->nkc", matrix, part.harmonics[:, :kept])
        return replace(
            part,
            means=part.means @ turn.T + self.move,
            quaternions=quaternions(turn @ rotations(part.quaternions)),
            harmonics=harmonics,
        )

    def points(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Points of the capture in the joined world."""
        return points @ self.turn.T.to(points) + self.move.to(points)

    def back(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
        """Points of the joined world in the axes of the capture."""
        return (points - self.move) @ self.turn.to(points)

    def cameras_back(self, cameras: Cameras) -> Cameras:
        """Cameras of the joined world in the axes of the capture."""
        pose = cameras.pose.clone()
        pose[:, :, :3] = torch.einsum("ji,vjk->vik", self.turn, cameras.pose[:, :, :3])
        pose[:, :, 3] = self.back(cameras.pose[:, :, 3])
        return replace(cameras, pose=pose)


UNMOVED = Placement(torch.eye(3).double(), torch.zeros(3))
"""The place of a capture that is alone."""


class JoinedWorld(NamedTuple):
    """The world that captures are seen in together."""

    placements: tuple[Placement, ...]
    up: Direction | None
    """None = no file says it, and captures agree: the ground of all together may."""
    up_reason: str
    north: North | None
    notes: tuple[str, ...]
    """A line for each that differs from the first: for what it was taken."""


def axes_of(capture: Capture, asked: Direction | None = None) -> CaptureAxes:
    """Up and north of a capture: as asked, else as its file says or its ground shows."""
    path = capture.path
    north = capture.north
    if asked is not None:
        return CaptureAxes(path=path, up=asked, reason="--up says so", said=True, north=north)
    if capture.up is not None:
        reason = capture.up_reason or "the file says so"
        return CaptureAxes(path=path, up=capture.up, reason=reason, said=True, north=north)
    ground = find_ground(capture.gaussians.drawable())
    # A slab at +z is a wall, as photographs along z see it; no program has its captures stand on one.
    if ground is None or ground.up == (0.0, 0.0, -1.0):
        reason = "as in most captures, since nothing in this one tells it"
        return CaptureAxes(path=path, up=USUAL_UP, reason=reason, told=False, north=north)
    return CaptureAxes(path=path, up=ground.up, reason=str(ground), north=north)


def joined_world(parts: Sequence[Gaussians], axes: Sequence[CaptureAxes]) -> JoinedWorld:
    """One world of the Gaussians of several captures, each in its own axes.

    Captures that lie beside one another and agree on up and north are neighbours: they stay. All others are of worlds of
    their own: they are turned until up and north are those of the first, and put in a row.
    """
    means = [part.means for part in parts]
    if _agree(axes) and not _overlap([_box(each) for each in means]):
        return _as_said([UNMOVED] * len(parts), axes)
    up = _unit(axes[0].up)
    turns, north = _turns_of(axes, up)
    placements = _in_a_row(means, turns, up)
    if not any(each.turned for each in placements):
        return _as_said(placements, axes)
    notes = []
    for each in axes:
        if each.up != axes[0].up:
            notes.append(each.note)
        if north is not None and _level_north(each) is None:
            notes.append(
                f"{each.path}: nothing tells its north; azimuths count as beside it ({north.source})"
            )
    return JoinedWorld(tuple(placements), axes[0].up, axes[0].reason, north, tuple(notes))


def _as_said(placements: Sequence[Placement], axes: Sequence[CaptureAxes]) -> JoinedWorld:
    """A world in whose axes all captures are: what one of them says of up and north holds for all."""
    up = next((each for each in axes if each.said), None)
    north = next((each.north for each in axes if each.north is not None), None)
    if up is None:
        return JoinedWorld(tuple(placements), None, "", north, ())
    return JoinedWorld(tuple(placements), up.up, up.reason, north, ())


def _agree(axes: Sequence[CaptureAxes]) -> bool:
    """True where no two captures tell directions of up or north that differ by more than their errors."""
    for one, other in itertools.combinations(axes, 2):
        if one.told and other.told and _degrees(_unit(one.up), _unit(other.up)) > _MAX_UP_DEGREES:
            return False
        north = _level_north(one)
        other_north = _level_north(other)
        if (
            north is not None
            and other_north is not None
            and _degrees(north, other_north) > _MAX_NORTH_DEGREES
        ):
            return False
    return True


def _turns_of(
    axes: Sequence[CaptureAxes], up: Annotated[Tensor, "3"]
) -> tuple[list[Annotated[Tensor, "3 3"]], North | None]:
    """The turn of each capture to a direction up and one north, and that north: of the first capture that has one."""
    turns = []
    there = None
    north = None
    for each in axes:
        turn = _shortest_turn(_unit(each.up), up)
        level = _level_north(each)
        if level is not None and each.north is not None:
            level = turn @ level
            if there is None:
                there = level
                x, y, z = level.tolist()
                north = replace(each.north, direction=(x, y, z))
            elif _degrees(level, there) > _SAME_DEGREES:
                turn = _turn_about(up, level, there) @ turn
        turns.append(turn)
    return turns, north


def _in_a_row(
    means: Sequence[Annotated[Tensor, "N 3"]],
    turns: Sequence[Annotated[Tensor, "3 3"]],
    up: Annotated[Tensor, "3"],
) -> list[Placement]:
    """Turned captures beside one another along a level axis; where one is turned all stand about the first."""
    along = 1 if abs(float(up[0])) > abs(float(up[1])) else 0
    turned = any(Placement(turn, UNMOVED.move).turned for turn in turns)
    middle = None
    at = 0.0
    placements = []
    for own, turn in zip(means, turns, strict=True):
        low, high = _box(own @ turn.to(own).T)
        move = torch.zeros(3)
        if turned and middle is not None:
            move = middle - (low + high) / 2
        if middle is None:
            middle = (low + high) / 2
        move[along] = at - float(low[along])
        at += (1 + _ROW_GAP) * float(high[along] - low[along])
        placements.append(Placement(turn, move))
    return placements


def _box(means: Annotated[Tensor, "N 3"]) -> tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]:
    """Lowest and highest corner; stray Gaussians do not make neighbours of captures that are apart."""
    inner = means[torch.from_numpy(bulk_of(means.numpy()).apart <= 0.5)]
    return inner.amin(0), inner.amax(0)


def _overlap(boxes: Sequence[tuple[Annotated[Tensor, "3"], Annotated[Tensor, "3"]]]) -> bool:
    """True where any two boxes, lowest and highest corner, lie in one place."""
    for (low, high), (other_low, other_high) in itertools.combinations(boxes, 2):
        shared = (torch.minimum(high, other_high) - torch.maximum(low, other_low)).clamp_min(0)
        smaller = torch.minimum(high - low, other_high - other_low)
        if bool((shared > _MIN_OVERLAP * smaller).all()):
            return True
    return False


def _unit(direction: Direction) -> Annotated[Tensor, "3"]:
    return torch.nn.functional.normalize(torch.tensor(direction).double(), dim=0)


def _level_north(axes: CaptureAxes) -> Annotated[Tensor, "3"] | None:
    """The level direction of north of a capture; None where it is not known."""
    if axes.north is None:
        return None
    return level_direction(_unit(axes.north.direction), _unit(axes.up))


def _degrees(one: Annotated[Tensor, "3"], other: Annotated[Tensor, "3"]) -> float:
    """Angle between two unit vectors."""
    sine = float(torch.linalg.cross(one, other).norm())
    return math.degrees(math.atan2(sine, float(one @ other)))


def _shortest_turn(start: Annotated[Tensor, "3"], end: Annotated[Tensor, "3"]) -> Annotated[Tensor, "3 3"]:
    """The rotation by the least angle between unit vectors; half a turn about any axis square to them where they are
    opposite.
    """
    identity = torch.eye(3).double()
    if _degrees(start, end) < _SAME_DEGREES:
        return identity
    if _degrees(start, -end) < _SAME_DEGREES:
        axis = identity[int(start.abs().argmin())]
        axis = torch.nn.functional.normalize(axis - (axis @ start) * start, dim=0)
        return 2 * torch.outer(axis, axis) - identity
    return _turn_about(torch.nn.functional.normalize(torch.linalg.cross(start, end), dim=0), start, end)


def _turn_about(
    axis: Annotated[Tensor, "3"], start: Annotated[Tensor, "3"], end: Annotated[Tensor, "3"]
) -> Annotated[Tensor, "3 3"]:
    """The rotation about an axis that takes one unit vector square to it to another."""
    begin = torch.stack([axis, start, torch.linalg.cross(axis, start)], 1)
    after = torch.stack([axis, end, torch.linalg.cross(axis, end)], 1)
    return after @ begin.T
