"""Light that reaches points through 3D Gaussians along one direction.

N Gaussians take light away, M points receive it. A ray meets a Gaussian most where it
comes nearest to its mean, by the Gaussian's own measure; there it takes away

    alpha = opacity exp(-d^2 / 2),      T = product over the Gaussians above the point of (1 - alpha),

with d the least distance in standard deviations. That is what splatting computes for a camera at infinity, but
for points in the place of pixels, and for the height at which the ray meets each Gaussian in the place of that
of its mean: the Gaussians of one surface do not shadow each other, however large they are and however low the
light stands.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..ops.threads import on_threads
from ..ops.transport_kernels import COLUMNS, Lists, Receivers, count, fill, project, reach

_MAX_COLUMNS = 256
"""Cells of the grid across the light, a side, at most: more lists than that take longer to write than to read."""
_GAUSSIANS_PER_CELL = 8
"""Gaussians for each cell, about (by eye)."""


class Blockers(NamedTuple):
    """Gaussians that take light away."""

    means: Annotated[Tensor, "N 3"]
    covariances: Annotated[Tensor, "N 6"]
    """xx xy xz yy yz zz."""
    opacities: Annotated[Tensor, "N"]


def covariances_of(
    quaternions: Annotated[Tensor, "N 4"], log_scales: Annotated[Tensor, "N 3"]
) -> Annotated[Tensor, "N 6"]:
    """Covariances xx xy xz yy yz zz of Gaussians with rotations w x y z of any length."""
    axes = axes_of(quaternions) * log_scales.exp()[:, None]
    full = axes @ axes.transpose(1, 2)
    return full.flatten(1)[:, [0, 1, 2, 4, 5, 8]].contiguous()


def axes_of(quaternions: Annotated[Tensor, "N 4"]) -> Annotated[Tensor, "N 3 3"]:
    """Rotations of quaternions w x y z; own axes are the columns."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)


def frame_of(
    light: Annotated[Tensor, "3"], level: Annotated[Tensor, "3"] | None = None
) -> Annotated[Tensor, "3 3"]:
    """Rows: two axes across a light, and the unit vector to it; the first is square to `level`, if given."""
    light = torch.nn.functional.normalize(light.double(), dim=0)
    if level is None or float(torch.linalg.cross(level.double(), light).norm()) < 1e-3:
        level = torch.eye(3, dtype=torch.float64)[int(light.abs().argmin())]
    x = torch.nn.functional.normalize(torch.linalg.cross(level.double(), light), dim=0)
    return torch.stack([x, torch.linalg.cross(light, x), light])


@torch.inference_mode()
def transport(
    blockers: Blockers,
    points: Annotated[Tensor, "M 3"],
    frame: Annotated[Tensor, "3 3"],
    offset: Annotated[Tensor, "M"],
    soft: Annotated[Tensor, "M"],
    blur: float = 0.0,
) -> Annotated[Tensor, "M"]:
    """Share of light in [0, 1] that reaches points.

    `frame` is that of `frame_of`. A Gaussian counts where a ray meets it more than `offset` above the point,
    and fully from `offset` + `soft` on. Gaussians are widened
    across the light by a deviation of `blur`. Computed on the CPU; the result is where the points are.
    """
    device = points.device
    points = points.cpu()
    frame = frame.float().cpu()
    blockers = Blockers(*(each.cpu() for each in blockers))
    # Into the frame of the light, about the middle, where float32 is fine.
    middle = blockers.means.mean(0) if len(blockers.means) else points.mean(0)
    turn = frame.numpy()
    place = ((points - middle) @ frame.T).contiguous().numpy()
    means = (blockers.means - middle).contiguous().numpy()
    rows = np.empty((len(means), COLUMNS), np.float32)
    gaussians = (means, blockers.covariances.contiguous().numpy(), blockers.opacities.contiguous().numpy())
    on_threads(project, gaussians, np.ascontiguousarray(turn), np.float32(blur**2), rows)
    rows = rows[rows[:, 10] >= 0]
    rows = rows[np.argsort(-rows[:, 9], kind="stable")]
    # Lines of the grid lie where the points are: the same number between any two of them.
    columns = int(min(_MAX_COLUMNS, max(1, math.sqrt(len(rows) / _GAUSSIANS_PER_CELL))))
    lines = []
    for axis in range(2):
        some = place[:: max(1, len(place) // 20_000), axis]
        lines.append(np.quantile(some, np.linspace(0, 1, columns + 1)[1:-1]).astype(np.float32))
    ranges = np.empty((len(rows), 4), np.int32)
    for axis in range(2):
        ranges[:, 2 * axis] = np.searchsorted(lines[axis], rows[:, axis] - rows[:, 10 + axis])
        ranges[:, 2 * axis + 1] = np.searchsorted(lines[axis], rows[:, axis] + rows[:, 10 + axis])
    starts = np.zeros(columns * columns + 1, np.int64)
    count(ranges, columns, starts)
    ids = np.empty(starts[-1], np.int32)
    fill(ranges, columns, starts[:-1].copy(), ids)
    cells = np.searchsorted(lines[1], place[..., 1]) * columns + np.searchsorted(lines[0], place[..., 0])
    receivers = Receivers(
        np.argsort(cells, kind="stable"),
        place,
        cells,
        offset.float().cpu().contiguous().numpy(),
        soft.float().cpu().clamp_min(1e-12).contiguous().numpy(),
    )
    out = np.empty(len(place), np.float32)
    on_threads(reach, receivers, Lists(starts, ids, rows), out)
    return torch.from_numpy(out).to(device)


def disc_directions(
    light: Annotated[Tensor, "3"], up: Annotated[Tensor, "3"], degrees: float, count: int
) -> Annotated[Tensor, "count 3"]:
    """Unit vectors to places spread evenly over a disc of a diameter about a light."""
    at = torch.arange(count, dtype=torch.float64) + 0.5
    radius = math.tan(math.radians(degrees / 2)) * (at / count).sqrt()
    turn = at * (math.pi * (3 - 5**0.5))
    across = frame_of(light, up)
    offset = turn.cos()[:, None] * across[0] + turn.sin()[:, None] * across[1]
    return torch.nn.functional.normalize(across[2] + radius[:, None] * offset, dim=1)


_SKY_DIRECTIONS = 16
"""Directions of the sky that openness is the mean of."""
_LOWEST_SKY = 0.1
"""Sine of the lowest one's height: below it everything is in the way of everything."""


def sky_directions(up: Annotated[Tensor, "3"], count: int = _SKY_DIRECTIONS) -> Annotated[Tensor, "count 3"]:
    """Unit vectors spread evenly over the sky, by the golden angle."""
    at = torch.arange(count, dtype=torch.float64)
    height = _LOWEST_SKY + (1 - _LOWEST_SKY) * (at + 0.5) / count
    turn = at * (math.pi * (3 - 5**0.5))
    flat = (1 - height.square()).sqrt()
    across = frame_of(up)
    return (
        flat[:, None] * (turn.cos()[:, None] * across[0] + turn.sin()[:, None] * across[1])
        + height[:, None] * across[2]
    )


@torch.inference_mode()
def openness(
    blockers: Blockers,
    points: Annotated[Tensor, "M 3"],
    normals: Annotated[Tensor, "M 3"],
    up: Annotated[Tensor, "3"],
    offset: Annotated[Tensor, "M"],
    soft: Annotated[Tensor, "M"],
    blur: float = 0.0,
) -> Annotated[Tensor, "M"]:
    """Share of the sky's light in [0, 1] that reaches points: the mean over directions of the sky, by how far
    surfaces face them.
    """
    total = points.new_zeros(len(points))
    facing = points.new_zeros(len(points))
    for direction in sky_directions(up.cpu()):
        weight = (normals @ direction.to(normals)).clamp_min(_LEAST_FACING)
        total += weight * transport(blockers, points, frame_of(direction), offset, soft, blur=blur)
        facing += weight
    return total / facing


_LEAST_FACING = 0.05
"""Weight of a direction that a surface does not face: so that what faces none has a mean."""
