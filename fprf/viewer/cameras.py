"""Cameras of clients, and what is drawn over the scene as line segments: captured cameras, blocks, the path of a film.

The capture's world is float64 in its own units with OpenGL's camera axes. The page's world is recentred and scaled, so that a
browser's float32 and flight speed suit it; its cameras look along +z with y down (OpenCV), as quaternions w x y z. What
clients send is checked, then bounded.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import UsageError
from ..rendering.cameras import Cameras
from ..rendering.paths import pinhole
from ..rendering.space import Space
from ..rendering.splines import quaternions, rotations
from ..types import Cell

Segments = NDArray[np.float32]
"""Line segments [N 2 3], page units."""

_MAX_DISTANCE = 1e6
"""Page units from the origin."""
_FOV = (0.02, 3.0)
"""Vertical angles in radians that are rendered."""
_ASPECT = (0.1, 10.0)
_MAX_SIDE = 4096
"""Longest side of a picture that a client may request."""
_FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""Between OpenGL's and OpenCV's camera axes."""
_EDGES = ((0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7))
"""Of a box whose corner c has its bit k set where it lies at the high end of axis k."""


class CameraState(NamedTuple):
    """A client's camera in the page's world; hashable."""

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    """Vertical, radians."""
    aspect: float
    """Width / height."""

    def for_aspect(self, aspect: float) -> "CameraState":
        """Narrow the angle on a wider page by half, in the logarithm, of what its sides would show beyond the photograph."""
        tangent = math.tan(self.fov / 2) * math.sqrt(min(1.0, self.aspect / aspect))
        return self._replace(fov=2 * math.atan(tangent), aspect=aspect)


class PageTransform(NamedTuple):
    """The map from the capture's world to the page's."""

    centre: Annotated[Tensor, "3"]
    """World point that is the page's origin, float64."""
    scale: float
    """Page units of one world unit."""
    up: tuple[float, float, float]

    def to_page(self, points: Annotated[Tensor, "... 3"]) -> Annotated[Tensor, "... 3"]:
        """World points on the page, float64."""
        return (points.double() - self.centre) * self.scale

    def camera_state(self, cameras: Cameras, view: int) -> CameraState:
        """A captured camera as a client's; its principal point and distortion are left out."""
        pose = cameras.pose[view]
        width, height = (float(v) for v in cameras.size[view])
        fov = 2 * math.atan(height / 2 / float(cameras.focal[view, 1]))
        w, x, y, z = quaternions((pose[:, :3] @ _FLIP)[None])[0].tolist()
        a, b, c = self.to_page(pose[:, 3]).tolist()
        return CameraState((w, x, y, z), (a, b, c), fov, width / height)

    def cameras(self, states: Sequence[CameraState], size: tuple[int, int]) -> Cameras:
        """Pinhole cameras of `size` (width, height) with square pixels; each keeps its vertical angle."""
        width, height = size
        turn = rotations(torch.tensor([state.wxyz for state in states], dtype=torch.float64)) @ _FLIP
        place = torch.tensor([state.position for state in states], dtype=torch.float64) / self.scale + self.centre
        focal = torch.tensor([height / 2 / math.tan(state.fov / 2) for state in states], dtype=torch.float64)
        frames = pinhole(torch.cat([turn, place[:, :, None]], -1), width=width, height=height, fov=90.0)
        return replace(frames, focal=focal[:, None].repeat(1, 2))


def page_transform(cameras: Cameras) -> PageTransform:
    """The transform of a capture: its cameras about the origin, nine in ten of them within two units."""
    place = cameras.pose[:, :, 3].double()
    centre = place.median(dim=0).values
    spread = float((place - centre).norm(dim=-1).quantile(0.9))
    up = torch.nn.functional.normalize(cameras.pose[:, :, 1].double().mean(0), dim=0)
    if not bool(up.isfinite().all()) or float(up.norm()) < 0.5:  # cameras that look every way have no common up
        up = torch.tensor([0.0, 0.0, 1.0])
    x, y, z = up.tolist()
    return PageTransform(centre, 2 / spread if spread > 0 else 1.0, (x, y, z))


def checked_camera(wxyz: Sequence[float], position: Sequence[float], fov: float, width: float, height: float) -> CameraState:
    """A camera of a client's numbers, with angle, place and shape bounded. Raises UsageError for what is no camera."""
    numbers = [float(x) for x in (*wxyz, *position, fov, width, height)]
    if len(numbers) != 10 or not all(math.isfinite(x) for x in numbers):
        raise UsageError("camera: ten finite numbers are needed: quaternion, position, angle, width and height")
    length = math.hypot(*numbers[:4])
    if not 1e-3 < length < 1e3:
        raise UsageError(f"camera: a quaternion of length {length:.3g} is no rotation")
    w, x, y, z = (v / length for v in numbers[:4])
    a, b, c = (_clamp(v, (-_MAX_DISTANCE, _MAX_DISTANCE)) for v in numbers[4:7])
    aspect = max(1.0, numbers[8]) / max(1.0, numbers[9])
    return CameraState((w, x, y, z), (a, b, c), _clamp(numbers[7], _FOV), _clamp(aspect, _ASPECT))


def picture_size(aspect: float, longest: int) -> tuple[int, int]:
    """Width and height of a picture of that aspect whose longer side is `longest` (8 to 4096)."""
    side = max(8, min(longest, _MAX_SIDE))
    shape = (side, side / aspect) if aspect >= 1 else (side * aspect, side)
    return max(1, round(shape[0])), max(1, round(shape[1]))


def camera_frustums(transform: PageTransform, cameras: Cameras, size: float, *, behind: bool = False) -> Segments:
    """A pyramid for each camera, `size` page units deep, with a roof on the side that is up.

    One that lies `behind` its camera is not seen from there.
    """
    width, height = cameras.size.double().unbind(-1)
    right, up = width / 2 / cameras.focal[:, 0], height / 2 / cameras.focal[:, 1]
    ahead = torch.full_like(right, -1.0)
    corners = torch.stack([torch.stack([x * right, y * up, ahead], -1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], 1)
    roof = torch.stack([torch.zeros_like(up), 1.5 * up, ahead], -1)[:, None]
    local = torch.cat([torch.zeros_like(roof), corners, roof], 1) * size
    if behind:
        local = local + torch.tensor([0.0, 0.0, size], dtype=local.dtype)
    points = (cameras.pose[:, None, :, :3] @ local[..., None])[..., 0] + transform.to_page(cameras.pose[:, None, :, 3])
    return _segments(points, ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (4, 5), (5, 3)))


def box_edges(transform: PageTransform, space: Space, cells: Sequence[Cell]) -> Segments:
    """The edges of a scene's blocks."""
    bits = torch.tensor([[c >> k & 1 for k in range(3)] for c in range(8)], dtype=torch.float64)
    place = torch.stack([cell.low + (cell.high - cell.low) * bits for cell in cells])
    rotation, centre = torch.tensor(space.rotation, dtype=torch.float64), torch.tensor(space.centre, dtype=torch.float64)
    return _segments(transform.to_page(place / space.scale @ rotation + centre), _EDGES)


def path_segments(transform: PageTransform, cameras: Cameras) -> Segments:
    """From each frame's position to the next."""
    place = transform.to_page(cameras.pose[:, :, 3])
    return _array(torch.stack([place[:-1], place[1:]], 1))


def _segments(points: Annotated[Tensor, "M P 3"], pairs: tuple[tuple[int, int], ...]) -> Segments:
    return _array(points[:, torch.tensor(pairs)].reshape(-1, 2, 3))


def _array(segments: Annotated[Tensor, "N 2 3"]) -> Segments:
    return np.asarray(segments.float().numpy())


def _clamp(value: float, bounds: tuple[float, float]) -> float:
    return min(bounds[1], max(bounds[0], value))
