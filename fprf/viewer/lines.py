"""What is drawn over the scene: captured cameras, the boxes of blocks, the flight of a film; as line segments on the page."""

from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..rendering.cameras import Cameras
from ..rendering.space import Space
from ..types import Boxes
from .cameras import Stage

__all__ = ["Segments", "box_lines", "camera_lines", "path_lines"]

Segments = NDArray[np.float32]
"""[N 2 3], page units."""

_EDGES = ((0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7))
"""Of a box whose corner c has its bit k set where it lies at the high end of axis k."""


def camera_lines(stage: Stage, cameras: Cameras, size: float, *, behind: bool = False) -> Segments:
    """A pyramid for each camera, `size` page units deep, with a roof on the side that is up.

    One that lies `behind` its camera is not seen by who stands there.
    """
    width, height = cameras.size.double().unbind(-1)
    right, up = width / 2 / cameras.focal[:, 0], height / 2 / cameras.focal[:, 1]
    ahead = torch.full_like(right, -1.0)
    corners = torch.stack([torch.stack([x * right, y * up, ahead], -1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], 1)
    roof = torch.stack([torch.zeros_like(up), 1.5 * up, ahead], -1)[:, None]
    local = torch.cat([torch.zeros_like(roof), corners, roof], 1) * size
    if behind:
        local = local + torch.tensor([0.0, 0.0, size], dtype=local.dtype)
    page = (cameras.pose[:, None, :, :3] @ local[..., None])[..., 0] + stage.to_page(cameras.pose[:, None, :, 3])
    pairs = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (4, 5), (5, 3))
    return _joined(page, pairs)


def box_lines(stage: Stage, space: Space, boxes: Boxes) -> Segments:
    """The edges of a scene's blocks."""
    bits = torch.tensor([[c >> k & 1 for k in range(3)] for c in range(8)], dtype=torch.float64)
    turned = boxes.low[:, None] + (boxes.high - boxes.low)[:, None] * bits
    # x lies in a cell where low <= turn x <= high, so a corner is turn^T of its own coordinates.
    place = turned @ boxes.turn
    rotation, centre = torch.tensor(space.rotation, dtype=torch.float64), torch.tensor(space.centre, dtype=torch.float64)
    return _joined(stage.to_page(place / space.scale @ rotation + centre), _EDGES)


def path_lines(stage: Stage, cameras: Cameras) -> Segments:
    """From each frame's place to the next."""
    place = stage.to_page(cameras.pose[:, :, 3])
    return _array(torch.stack([place[:-1], place[1:]], 1))


def _joined(points: Annotated[Tensor, "M P 3"], pairs: tuple[tuple[int, int], ...]) -> Segments:
    index = torch.tensor(pairs)
    return _array(points[:, index].reshape(-1, 2, 3))


def _array(lines: Annotated[Tensor, "N 2 3"]) -> Segments:
    return np.asarray(lines.float().numpy())
