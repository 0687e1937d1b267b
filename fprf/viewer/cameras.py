"""Between the capture's world and the page's: recentred and scaled, so that a browser's float32 and flight speed suit it.

The world is float64 in the capture's units with OpenGL's camera axes; the page's cameras look along +z with y down
(OpenCV's), as quaternions w x y z. What clients send is taken for numbers of a stranger: checked, then bounded.
"""

import math
from collections.abc import Sequence
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..errors import UsageError
from ..rendering.cameras import Cameras
from ..rendering.lens import PINHOLE
from ..rendering.splines import quaternions, rotations

__all__ = ["Eye", "Stage", "checked_eye", "fitted", "stage_of"]

_REACH = 1e6
"""Page units: farther out nobody is."""
_FOV = (0.02, 3.0)
"""Vertical angles in radians that are rendered."""
_ASPECT = (0.1, 10.0)
_SIDES = 4096
"""Longest side of a picture that a client may ask for."""
_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))


class Eye(NamedTuple):
    """A client's camera, in the page's world; hashable, so that equal views can be told."""

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    """Vertical, radians."""
    aspect: float
    """Width / height."""


class Stage(NamedTuple):
    """The map between both worlds."""

    centre: Annotated[Tensor, "3"]
    """World point that is the page's origin, float64."""
    scale: float
    """Page units of one world unit."""
    up: tuple[float, float, float]

    def to_page(self, points: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "... 3"]:
        """World points on the page, float64."""
        return (points.double() - self.centre) * self.scale

    def eye(self, cameras: Cameras, view: int) -> Eye:
        """A captured camera as a client's; its principal point and distortion are left out."""
        pose = cameras.pose[view]
        width, height = (float(v) for v in cameras.size[view])
        fov = 2 * math.atan(height / 2 / float(cameras.focal[view, 1]))
        w, x, y, z = quaternions((pose[:, :3] @ _TURN)[None])[0].tolist()
        a, b, c = self.to_page(pose[:, 3]).tolist()
        return Eye((w, x, y, z), (a, b, c), fov, width / height)

    def cameras(self, eyes: Sequence[Eye], size: tuple[int, int]) -> Cameras:
        """Eyes as pinhole cameras of `size` (width, height), square pixels; the height keeps each one's angle."""
        width, height = size
        turn = rotations(torch.tensor([eye.wxyz for eye in eyes], dtype=torch.float64)) @ _TURN
        place = torch.tensor([eye.position for eye in eyes], dtype=torch.float64) / self.scale + self.centre
        focal = torch.tensor([height / 2 / math.tan(eye.fov / 2) for eye in eyes], dtype=torch.float64)
        count = len(eyes)
        return Cameras(
            pose=torch.cat([turn, place[:, :, None]], -1),
            focal=focal[:, None].repeat(1, 2),
            centre=torch.tensor([width / 2, height / 2], dtype=torch.float64).repeat(count, 1),
            size=torch.tensor([width, height]).repeat(count, 1),
            distortion=torch.zeros(count, 6, dtype=torch.float64),
            lens=torch.full((count,), PINHOLE),
        )


def stage_of(cameras: Cameras) -> Stage:
    """The stage of a capture: its cameras about the origin, nine in ten of them within two units."""
    place = cameras.pose[:, :, 3].double()
    centre = place.median(dim=0).values
    spread = float((place - centre).norm(dim=-1).quantile(0.9))
    up = torch.nn.functional.normalize(cameras.pose[:, :, 1].double().mean(0), dim=0)
    if not bool(up.isfinite().all()) or float(up.norm()) < 0.5:  # cameras that look every way have no common up
        up = torch.tensor([0.0, 0.0, 1.0])
    x, y, z = up.tolist()
    return Stage(centre, 2 / spread if spread > 0 else 1.0, (x, y, z))


def checked_eye(wxyz: Sequence[float], position: Sequence[float], fov: float, width: float, height: float) -> Eye:
    """A client's numbers as an eye. Raises UsageError for what is no camera; angles and shapes are bounded."""
    numbers = [float(x) for x in (*wxyz, *position, fov, width, height)]
    if len(numbers) != 10 or not all(math.isfinite(x) for x in numbers):
        raise UsageError("camera: ten finite numbers are needed: quaternion, position, angle, width and height")
    length = math.hypot(*numbers[:4])
    if not 1e-3 < length < 1e3:
        raise UsageError(f"camera: a quaternion of length {length:.3g} is no rotation")
    w, x, y, z = (v / length for v in numbers[:4])
    a, b, c = (min(_REACH, max(-_REACH, v)) for v in numbers[4:7])
    aspect = max(1.0, numbers[8]) / max(1.0, numbers[9])
    return Eye((w, x, y, z), (a, b, c), _bounded(numbers[7], _FOV), _bounded(aspect, _ASPECT))


def fitted(aspect: float, longest: int) -> tuple[int, int]:
    """Width and height of a picture of that shape whose longer side is `longest` (at most 4096)."""
    side = max(8, min(longest, _SIDES))
    shape = (side, side / aspect) if aspect >= 1 else (side * aspect, side)
    return max(1, round(shape[0])), max(1, round(shape[1]))


def _bounded(value: float, bounds: tuple[float, float]) -> float:
    return min(bounds[1], max(bounds[0], value))
