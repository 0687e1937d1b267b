"""From a scene's cameras and points to its space: kind, centre, scale, near and far are found, never asked
for.

forward-facing (all cameras look one way, and stand close together against the depth of what they see)   -> ndc
images with transparency (a bounded object)                                                              -> box
anything else                                                                                            -> contraction
"""

import math
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor

from ..errors import DataError
from ..rendering.cameras import Cameras, rays_through
from ..rendering.space import Kind, Space
from .scene import ParsedScene

MAX_FORWARD_ANGLE = math.radians(35)
"""Cameras that all look within this angle (radians) of their mean direction may be forward-facing: by eye."""
MAX_FORWARD_SPREAD = 0.5
"""... if they also stand within this share of the median depth of what they see: by eye."""
BOX_SHARE = 0.45
"""Half the side of an object's box, as a share of the cameras' distance to its centre: by eye."""
FAR = 1e3
"""Farthest distance in the contraction, in units of the scene's inner radius: beyond it disparity is below
1e-3.
"""
NEAR = 0.05
"""Nearest distance in the contraction where nothing is known of depths, in units of the inner radius: by
eye.
"""
MARGIN = 1.02
"""Bounds are this much wider than what the training rays span, so that no training point lies on a border."""
MAX_DEPTHS = 1 << 22
"""About how many depths of points are looked at; a large capture has billions, and quantile() takes 16
million.
"""
_MAX_SPREAD_POINTS = 1 << 24
"""Points whose spread is measured, at most: as many as quantile() takes."""
ROUNDING = 1e-12
"""Cameras closer together than this share of their coordinates stand in one place: the rest is float64's
rounding.
"""


def focus(cameras: Cameras) -> tuple[Annotated[Tensor, "3"], float]:
    """The point nearest to all optical axes, and how well it is determined: smallest over largest
    eigenvalue.
    """
    # Least squares: sum_i (1 - a_i a_i^T)(x - o_i) = 0 with the axes a_i, about the cameras' mean, where
    # float64 is finest.
    middle = cameras.pose[:, :, 3].mean(0)
    axis = -cameras.pose[:, :, 2]
    origin = cameras.pose[:, :, 3] - middle
    axis = axis / axis.norm(dim=-1, keepdim=True)
    across = torch.eye(3, dtype=axis.dtype) - axis[:, :, None] * axis[:, None, :]
    matrix = across.sum(0)
    values = torch.linalg.eigvalsh(matrix)
    # A least-squares ridge of 1e-9 keeps parallel axes solvable: the answer is then the cameras' own centre.
    ridge = 1e-9 * values[-1].clamp_min(1e-12) * torch.eye(3, dtype=axis.dtype)
    target = (across @ origin[:, :, None]).sum(0)
    return middle + torch.linalg.solve(matrix + ridge, target)[:, 0], float(
        values[0] / values[-1].clamp_min(1e-12)
    )


def find_space(scene: ParsedScene) -> Space:
    """The space of a scene. Raises DataError where cameras leave it undefined (all of them in one place, no
    points).
    """
    kind = find_kind(scene)
    if kind != "box":
        if kind == "ndc":
            return _ndc(scene)
        return _contraction(scene)
    position = scene.cameras.pose[:, :, 3]
    # The point that all cameras look at, or their middle where axes are parallel.
    centre, certain = focus(scene.cameras)
    if certain < 1e-4:
        centre = position.mean(0)
    distance = float((position - centre).norm(dim=-1).median())
    if distance <= ROUNDING * float(position.abs().amax()):
        raise DataError(f"{scene.name}: all cameras stand in one place; capture from several places")
    return Space("box", _three(centre), _rows(torch.eye(3)), 1 / (BOX_SHARE * distance), 0.0, FAR)


def find_kind(scene: ParsedScene) -> Kind:
    """Choose the one of the three that fits."""
    if scene.alpha:
        return "box"
    # Forward-facing: the cameras look one way ...
    cameras = scene.cameras
    axis = -cameras.pose[:, :, 2]
    mean = axis.mean(0)
    if len(cameras) < 3 or mean.norm() < math.cos(MAX_FORWARD_ANGLE):
        return "contraction"
    mean = mean / mean.norm()
    if (axis @ mean).amin() < math.cos(MAX_FORWARD_ANGLE) or (depth := _depths(scene)) is None:
        return "contraction"
    # ... and stand close together against the depth of what they see.
    offset = cameras.pose[:, :, 3] - cameras.pose[:, :, 3].mean(0)
    if offset.norm(dim=-1).amax() < MAX_FORWARD_SPREAD * depth.median():
        return "ndc"
    return "contraction"


def _depths(scene: ParsedScene) -> Tensor | None:
    """Depths that the capture knows: of its sparse points in every camera, or the middle of its near and
    far.
    """
    if scene.points is not None and len(scene.points) >= 8:
        pose = scene.cameras.pose
        points = scene.points[:: max(1, len(pose) * len(scene.points) // MAX_DEPTHS)]
        x, y, z = ((points[None] - pose[:, None, :, 3]) @ pose[:, :, :3]).unbind(-1)
        # Only what a view sees: a street passes points at no distance at all, beside its cameras.
        reach = (scene.cameras.size / scene.cameras.focal / 2)[:, :, None]
        seen = (z < 0) & (x.abs() < -z * reach[:, 0]) & (y.abs() < -z * reach[:, 1])
        return -z[seen] if bool(seen.any()) else None
    if scene.depths is not None:
        return scene.depths.prod(-1).sqrt()
    return None


def axes(cameras: Cameras) -> Tensor:
    """Rows: the direction along which the cameras spread, third axis, mean up. Planes then follow streets and
    walls.
    """
    up = cameras.pose[:, :, 1].mean(0)
    if (
        up.norm() < 0.3
    ):  # a full turn about the optical axis, or nadir views from all sides: any axis is as good
        up = torch.tensor([0.0, 0.0, 1.0], dtype=up.dtype)
    up = up / up.norm()
    # The direction of most spread across the vertical.
    offset = cameras.pose[:, :, 3] - cameras.pose[:, :, 3].mean(0)
    flat = offset - (offset @ up)[:, None] * up
    if len(flat) > 1:
        along = torch.linalg.svd(flat, full_matrices=False).Vh[0]
    else:
        along = cameras.pose[0, :, 0]
    along = along - (along @ up) * up
    if along.norm() < 1e-6:
        along = torch.linalg.svd(up[None], full_matrices=True).Vh[1]
    if (
        flat[-1] - flat[0]
    ) @ along < 0:  # a singular vector has either sign: onwards through the capture is the same anywhere
        along = -along
    along = along / along.norm()
    return torch.stack([along, torch.linalg.cross(up, along), up])


def _contraction(scene: ParsedScene) -> Space:
    cameras = scene.cameras
    position = cameras.pose[:, :, 3]
    rotation = axes(cameras)
    # The centre is what the cameras look at, where they surround something; else they stand around it.
    point, certain = focus(cameras)
    ahead = ((point - position) * -cameras.pose[:, :, 2]).sum(-1) > 0
    inward = certain > 0.02 and ahead.double().mean() > 0.9
    centre = point if inward else position.mean(0)
    # The inner radius holds most of the cameras, and half of the points if these are not much farther away.
    local = (position - centre) @ rotation.T
    radius = float(local.abs().amax(-1).quantile(0.9))
    if scene.points is not None and len(scene.points) >= 8:
        some = scene.points[:: -(-len(scene.points) // _MAX_SPREAD_POINTS)]
        spread = float(((some - centre) @ rotation.T).abs().amax(-1).quantile(0.5))
        radius = max(radius, min(spread, 3 * radius if radius > 0 else spread))
    if radius <= ROUNDING * float(position.abs().amax()):
        raise DataError(
            f"{scene.name}: all cameras stand in one place and there are no points; capture from several places"
        )
    nearest = _nearest(scene)
    if nearest is None:
        near = NEAR
    else:
        near = min(NEAR, 0.5 * nearest / radius)
    return Space("contraction", _three(centre), _rows(rotation), 1 / radius, max(near, 1e-3), FAR)


def _nearest(scene: ParsedScene) -> float | None:
    """Nearest depth that the capture says, else that of its sparse points but for a thousandth, which may be
    wrong.
    """
    if scene.depths is not None:
        return float(scene.depths[:, 0].amin())
    depth = _depths(scene)
    if depth is None:
        return None
    return float(depth.quantile(0.001 if len(depth) >= 1000 else 0.0))


def _ndc(scene: ParsedScene) -> Space:
    cameras = scene.cameras
    pose = cameras.pose
    # Axes of the mean camera: back, right, and what is across both.
    back = pose[:, :, 2].mean(0)
    back = back / back.norm()
    right = torch.linalg.cross(pose[:, :, 1].mean(0), back)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(back, right), back])
    nearest = _nearest(scene)
    assert nearest is not None  # find_kind asked
    # One frustum for all: the mean camera's, from a tenth before the nearest point on.
    size = cameras.size.double().mean(0)
    fx, fy = (2 * cameras.focal.mean(0) / size).tolist()
    centre = _three(pose[:, :, 3].mean(0))
    whole = Space("ndc", centre, _rows(rotation), 1.0, 0.9 * nearest, 1.0, focal=(fx, fy))
    # The box is what the rays of all image corners span from the near plane to infinity, a little widened.
    ends = []
    for view in range(len(cameras)):
        w, h = cameras.size[view].tolist()
        corner = torch.tensor([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]], dtype=torch.float64)
        rays = whole.rays(*rays_through(cameras, torch.full((4,), view), corner))
        ends += [rays.origin, rays.origin + rays.direction]
    spread = torch.cat(ends).double()
    low = spread.amin(0)
    high = spread.amax(0)
    middle = (low + high) / 2
    half = (high - low) / 2 * MARGIN
    left, bottom, _ = (middle - half).tolist()
    right_end, top, _ = (middle + half).tolist()
    return replace(whole, low=(left, bottom, -1.0), high=(right_end, top, 1.0))


def _three(x: Tensor) -> tuple[float, float, float]:
    a, b, c = x.tolist()
    return a, b, c


def _rows(matrix: Tensor) -> tuple[tuple[float, float, float], ...]:
    return tuple(_three(row) for row in matrix)
