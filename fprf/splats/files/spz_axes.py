"""The axes of a .spz file, and the change from them to those of PLY files, right down front.

The format's own are right up back, but converters leave those of the PLY that they read, and only the extension
`SPZ_ADOBE_coordinate_system` says which a file has. Without it the ground decides: captures in the axes of PLY
files have it at +y or, of Nerfstudio, at -z. splat-transform writes right up back before version 3, PLY's axes
from then on, Niantic's own converter PLY's; its apps right up back.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import DataError
from ...rendering.north import Bearings
from ..gaussians import Gaussians
from ..ground import find_ground
from . import base
from .base import Floats

RIGHT_UP_BACK = 4
"""Number of the axes that a file has by the format's text."""
RIGHT_DOWN_FRONT = 6
"""Number of the axes of PLY files, of which all programs agree how a file that says nothing is converted."""
_COORDINATE_SYSTEM = 0xADBE0003
"""Type of the extension that says which axes a file has; its payload is their number."""
_RECORD_HEAD = struct.Struct("<II")
"""Type of an extension and length of its payload, which follows."""
_OWN_BEARINGS = 0x46500001
"""Type of fprf's extension: the upper half names who it is of, and readers pass over those that they do not know."""
_BEARINGS = struct.Struct("<6f")
"""Its payload: north and up."""
_AXES_NUMBER = struct.Struct("<I")
"""The payload of the extension that names the axes."""
_MAX_AXES_NUMBER = 16
"""Numbers of axes: three bits for the ends of the axes, one for y and z swapped."""
_LIBRARY_FRACTION = 12
"""Fractional bits of positions in files of Niantic's library and all that build on it. fprf fits them to the
capture: any other number in version 3 is that of a file that it wrote before it named the axes.
"""
_LAST_VERSION_OF_APPS = 2
"""Files of the versions up to it come from Niantic's apps, almost all: converters are younger."""


class Axes(NamedTuple):
    """The axes of a file, against right down front: turned by 90 degrees about x, then mirrored."""

    turned: bool
    """z is up or down, y front or back."""
    signs: tuple[float, float, float]

    def points(self, points: Floats) -> Floats:
        """Points [N 3] of a file, right down front."""
        if self.turned:
            points = np.stack([points[:, 0], points[:, 2], -points[:, 1]], 1)
        return np.asarray(points * np.array(self.signs))

    def quaternions(self, turns: Floats) -> Floats:
        """Rotations [N 4], w x y z, as `points`. Mirroring the world and the own axes of a Gaussian leaves
        its shape.
        """
        if self.turned:
            w, x, y, z = turns.T * 0.5**0.5
            turns = np.stack([w + x, x - w, y + z, z - y], 1)
        a, b, c = self.signs
        return np.asarray(turns * np.array([1.0, b * c, a * c, a * b]))

    def harmonics(self, harmonics: Floats, back: bool = False) -> Floats:
        """Harmonics [N K 3] as `points`; `back`: those of a file."""
        bands = harmonics.shape[1]
        degree = np.sqrt(np.arange(bands)).astype(np.int64)
        order = np.arange(bands) - degree * (degree + 1)
        odd = np.where(order < 0, -1.0, 1.0)  # those of negative order have the sign of y
        flips = (odd * (-1.0) ** order, odd, (-1.0) ** (degree + order))
        parity = np.ones(bands)
        for flip, sign in zip(flips, self.signs, strict=True):
            if sign < 0:
                parity = parity * flip
        if not self.turned:
            return np.asarray(harmonics * parity[:, None])
        turn = base.turned_harmonics(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), bands)
        matrix = parity[:, None] * turn
        if back:
            matrix = matrix.T
        return np.asarray(np.matmul(matrix, harmonics))


PLY_AXES = Axes(False, (1.0, 1.0, 1.0))
"""Right down front: nothing changes."""
OWN_AXES = Axes(False, (1.0, -1.0, -1.0))
"""Right up back."""


def axes_record() -> bytes:
    """The extension that says that a file has the axes of PLY files."""
    return _RECORD_HEAD.pack(_COORDINATE_SYSTEM, _AXES_NUMBER.size) + _AXES_NUMBER.pack(RIGHT_DOWN_FRONT)


def bearings_record(bearings: Bearings) -> bytes:
    """The extension that says where north and up are, in the axes of PLY files; 0 0 0 = not known."""
    payload = _BEARINGS.pack(*bearings.north, *(bearings.up or (0.0, 0.0, 0.0)))
    return _RECORD_HEAD.pack(_OWN_BEARINGS, len(payload)) + payload


def said_bearings(extensions: bytes, axes: Axes) -> Floats | None:
    """North and up, as rows of an array, by the extension that names them; None without one."""
    at = 0
    while at + _RECORD_HEAD.size <= len(extensions):
        kind, size = _RECORD_HEAD.unpack_from(extensions, at)
        at += _RECORD_HEAD.size
        if kind == _OWN_BEARINGS and size == _BEARINGS.size and at + size <= len(extensions):
            return axes.points(np.array(_BEARINGS.unpack_from(extensions, at)).reshape(2, 3))
        at += size
    return None


def said_axes(path: Path, extensions: bytes, degree: int) -> Axes | None:
    """The axes that extensions name; None where they name none. Raises DataError for an unknown number, and
    for harmonics that cannot be turned.
    """
    number = 0
    at = 0
    while at < len(extensions):
        head = extensions[at : at + _RECORD_HEAD.size]
        size = 0
        if len(head) == _RECORD_HEAD.size:
            kind, size = _RECORD_HEAD.unpack(head)
        end = at + _RECORD_HEAD.size + size
        if end > len(extensions):
            raise base.short(path, len(extensions), end, "extensions")
        if kind == _COORDINATE_SYSTEM and size == _AXES_NUMBER.size:
            (said,) = _AXES_NUMBER.unpack_from(extensions, end - size)
            number = said or RIGHT_UP_BACK  # 0 stands for the format's own
            break
        at = end
    if number == 0:
        return None
    if number > _MAX_AXES_NUMBER:
        raise DataError(
            f"{path}: axes of number {number} (SPZ_ADOBE_coordinate_system); 1 to {_MAX_AXES_NUMBER} are known"
        )
    # Right, up and front are bits, another one swaps y and z.
    right, up, front, turned = (number - 1 >> k & 1 for k in range(4))
    if turned and degree > 3:
        raise DataError(
            f"{path}: harmonics of degree 4 with z up or down; save the file with y up, or with degree 3"
        )
    x = 2.0 * right - 1
    down = 1 - 2.0 * up
    ahead = 2.0 * front - 1
    # Turned, a point of right front up is (x, z, -y), and of right down front (x, -z, y).
    if turned:
        return Axes(True, (x, down, -ahead))
    return Axes(False, (x, down, ahead))


def guessed_axes(version: int, fraction: int, sample: Gaussians) -> tuple[Axes, str]:
    """The axes of a file that names none, by its ground, else by who writes files of its version, and the
    reason in words. `sample` are some of its Gaussians in its own axes.
    """
    own = "its axes are right up back, the format's own"
    ply = "its axes are right down front, those of the .ply that it was made from"
    ground = find_ground(sample)
    if ground is not None:
        # Up is -y or +z in the axes of PLY files: the same directions are +y and -z in right up back.
        if ground.up in ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0)):
            return OWN_AXES, f"{own}: {ground}"
        return PLY_AXES, f"{ply}: {ground}"
    turn = "where it comes out upside down, give --up 0 1 0"
    if version <= _LAST_VERSION_OF_APPS:
        return OWN_AXES, f"{own}, as mostly in version {version}; {turn}"
    if version == 3 and fraction != _LIBRARY_FRACTION:
        return OWN_AXES, f"{own}, as fprf wrote them before it named them"
    return PLY_AXES, f"{ply}, as converters leave them, since nothing in it says otherwise; {turn}"
