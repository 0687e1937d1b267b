"""Corrections of the captured poses: a turn and a shift a view, learnt with the scene.

Conventions. A move is [turn, shift]: a rotation vector in world axes about the camera's own centre (radians),
and the centre's shift in units of `reach`, the distance that views commonly see. So one step of the optimiser
moves a pixel about as far by either. A scene can be shifted, turned and scaled with all its cameras without
any image changing: these seven directions (to first order, about the mean of the cameras that are learnt
from) are taken out of every move, so the scene stays where the capture put it. Views that are held out never
move.

The surroundings of a scene of blocks find the moves of all views. Each block starts from those and goes on
with its own views, without those seven directions of its own, so neighbours stay together; rendering uses
what the surroundings found.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import torch
from torch import Tensor, nn

from ..datamanagers.scene import GAMMA
from ..rendering.cameras import Cameras
from ..types import Rays
from .facts import Facts

_TREND_RIDGES = (0.1, 1.0, 10.0)
"""Weights of the ridges that are tried, in views: those of some ten to a hundred."""
_CONSTANT_RIDGE = 1e-9
"""The part of a trend that is the same everywhere is not held back; above 0, so that it can be solved for one
view.
"""
_MIN_SPREAD = 1e-12
"""Mean distance below which views stand, or look, alike."""
_MIN_SQUARED_ANGLE = 1e-24
"""Square of an angle that float64 cannot tell from none: the root of nothing has no slope."""


class Poses(nn.Module):
    """Moves of V views."""

    known: Tensor
    learned: Tensor
    """int64 numbers of the views that are learnt from."""
    gauge: Tensor

    def __init__(
        self,
        centres: Annotated[Tensor, "V 3"],
        held: tuple[int, ...],
        *,
        reach: float,
        pace: float,
        still: bool = False,
    ) -> None:
        """`centres` are the cameras' in the world; `held` are views that are not learnt from. One unit of the
        parameters is `pace` radians, or reaches: how fast poses are learnt beside everything else. Where the
        scene is `still`, nothing is taken out of the moves.
        """
        super().__init__()
        views = len(centres)
        learned = torch.ones(views, dtype=torch.bool)
        learned[list(held)] = False
        self.reach = reach
        self.pace = pace
        self.offset = nn.Parameter(torch.zeros(views, 6))
        self.register_buffer("known", torch.zeros(views, 6))
        self.register_buffer("learned", learned.nonzero()[:, 0], persistent=False)
        # The seven directions of the gauge, in the units of the parameters.
        gauge = _gauge(centres[learned].double() / reach).float()
        self.register_buffer("gauge", gauge[:, :0] if still else gauge, persistent=False)

    def moves(self) -> Annotated[Tensor, "V 6"]:
        """Turn and shift of each view."""
        free = self.offset.index_select(0, self.learned).reshape(-1)
        free = free - self.gauge @ (self.gauge.T @ free)
        moves: Tensor = self.known.index_add(0, self.learned, self.pace * free.view(-1, 6))
        return moves

    def forward(
        self,
        view: Annotated[Tensor, "R"],
        origin: Annotated[Tensor, "R 3"],
        direction: Annotated[Tensor, "R 3"],
    ) -> tuple[Annotated[Tensor, "R 3"], Annotated[Tensor, "R 3"]]:
        """World rays (float64, unit directions) of the views as they are now."""
        # To the device first, since MPS has no float64.
        moves = self.moves().to(origin.device).to(origin.dtype)
        move = moves.index_select(0, view.to(origin.device))
        return origin + self.reach * move[:, 3:], rotated(direction, move[:, :3])

    def refined(self, cameras: Cameras) -> Cameras:
        """The cameras where they are now."""
        return moved_cameras(cameras, self.moved_by())

    @torch.no_grad()
    def moved_by(self) -> Annotated[Tensor, "V 6"]:
        """Turn (radians) and shift (world units) of each view, float64, on the CPU."""
        return self.moves().cpu().double() * torch.tensor(
            [1.0, 1, 1, self.reach, self.reach, self.reach], dtype=torch.float64
        )

    def going_on(self, centres: Annotated[Tensor, "V 3"], held: tuple[int, ...]) -> "Poses":
        """Poses that start as these are now, and learn from other views."""
        poses = Poses(centres, held, reach=self.reach, pace=self.pace)
        with torch.no_grad():
            poses.known.copy_(self.moves())
        return poses


def moved_cameras(cameras: Cameras, moves: Annotated[Tensor, "V 6"]) -> Cameras:
    """Cameras, each turned about its own centre and shifted."""
    moves = moves.to(cameras.pose.device).to(cameras.pose.dtype)
    axes = []
    for axis in range(3):
        axes.append(rotated(cameras.pose[:, :, axis], moves[:, :3]))
    return replace(cameras, pose=torch.stack([*axes, cameras.pose[:, :, 3] + moves[:, 3:]], -1))


def with_trend(
    moves: Annotated[Tensor, "V 6"], cameras: Cameras, learned: Sequence[int], reach: float
) -> Annotated[Tensor, "V 6"]:
    """Moves (radians, world units) in which views that were held out follow the trend of those `learned` from.

    Refined cameras bend as a whole (a focal length that is a little off does that), and the scene with them:
    a view that stays behind would be off by what its neighbours moved alike. The trend is a ridge regression
    on where the given `cameras` stand and look. Features and ridge are those that best predict each learned
    view from the others; there is no trend where none predicts better than no move. Photographs of views that
    were held out have no part in it.
    """
    views = torch.as_tensor(list(learned), dtype=torch.int64)
    others = torch.ones(len(moves), dtype=torch.bool)
    others[views] = False
    if not bool(moves[views].any()) or not bool(others.any()):
        return moves
    unit = torch.tensor([1.0, 1, 1, reach, reach, reach], dtype=torch.float64)
    known = moves[views].double() / unit
    one = torch.ones(len(moves), 1, dtype=torch.float64)
    place = _spread(cameras.pose[:, :, 3], views)
    look = _spread(cameras.pose[:, :, 2], views)
    least = float(known.square().sum())
    trend = torch.zeros_like(moves)
    for features in (torch.cat([one, place], 1), torch.cat([one, place, look], 1)):
        rows = features[views]
        for ridge in _TREND_RIDGES:
            penalty = ridge * torch.eye(features.shape[1], dtype=torch.float64)
            penalty[0, 0] = _CONSTANT_RIDGE
            weights = torch.linalg.solve(rows.T @ rows + penalty, rows.T)  # [features, learned]
            # Each learned view as the others predict it: residuals over 1 - h (Allen 1974).
            hat = (rows * weights.T).sum(1, keepdim=True)
            left = float(((known - rows @ (weights @ known)) / (1 - hat)).square().sum())
            if left < least:
                least = left
                trend = features @ (weights @ known) * unit
    return torch.where(others[:, None], trend.to(moves), moves)


def _spread(x: Annotated[Tensor, "V 3"], views: Annotated[Tensor, "M"]) -> Annotated[Tensor, "V 3"]:
    """Vectors about the mean of some views, in units of their mean distance from it."""
    apart = x.double().cpu() - x[views].double().cpu().mean(0)
    spread: Tensor = apart / apart[views].norm(dim=1).mean().clamp_min(_MIN_SPREAD)
    return spread


def rotated(x: Annotated[Tensor, "N 3"], turn: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 3"]:
    """Vectors turned by rotation vectors (Rodrigues), differentiable at 0 too."""
    square = turn.square().sum(-1, keepdim=True)
    angle = (square + _MIN_SQUARED_ANGLE).sqrt()
    across = torch.linalg.cross(turn, x)
    # (1 - cos a) / a^2 by the half angle: 1 - cos would cancel.
    half = torch.sin(angle / 2) / (angle / 2)
    turned: Tensor = (
        x + torch.sin(angle) / angle * across + 0.5 * half.square() * torch.linalg.cross(turn, across)
    )
    return turned


def rays_of_moving_cameras(rays: Rays) -> Rays:
    """Rays whose origin and direction alone lead gradients: samples are placed, and looks shaded, as if poses
    were fixed.
    """
    return Rays(rays.origin, rays.direction, rays.view.detach(), rays.near.detach(), rays.far.detach())


def _gauge(centres: Annotated[Tensor, "M 3"]) -> Annotated[Tensor, "6M G"]:
    """An orthonormal basis, G <= 7, of the moves that shift, turn or scale all cameras as one."""
    place = centres - centres.mean(0) if len(centres) else centres
    none = torch.zeros_like(place)
    axes = torch.eye(3, dtype=place.dtype)
    columns = []
    for axis in axes:
        columns.append(torch.cat([none, axis.expand_as(place)], -1))
    for axis in axes:
        about = axis.expand_as(place)
        columns.append(torch.cat([about, torch.linalg.cross(about, place)], -1))
    columns.append(torch.cat([none, place], -1))
    parts = []
    for column in columns:
        parts.append(column.reshape(-1))
    matrix = torch.stack(parts, -1)
    if not matrix.numel():
        return matrix
    basis, size, _ = torch.linalg.svd(matrix, full_matrices=False)
    # One view alone can be put anywhere; views in one place cannot be told to scale.
    kernel: Tensor = basis[:, size > 1e-9 * size[0]]
    return kernel


class Tones(nn.Module):
    """Factors of V views."""

    exposure: Tensor
    learned: Tensor
    known: Tensor

    def __init__(self, exposure: Annotated[Tensor, "V"], held: tuple[int, ...]) -> None:
        """`exposure` is `relative`; `held` are views that are not learnt from."""
        super().__init__()
        views = len(exposure)
        self.gain = nn.Parameter(torch.zeros(views, 3))
        self.exponent = nn.Parameter(torch.tensor(GAMMA))
        # Held-out views have no gain: nothing says what it would be.
        learned = torch.ones(views, 1)
        learned[list(held)] = 0
        self.register_buffer("exposure", exposure.float(), persistent=False)
        self.register_buffer("learned", learned, persistent=False)
        self.register_buffer("known", torch.zeros(views, 3), persistent=False)

    def gains(self) -> Annotated[Tensor, "V 3"]:
        """Logarithms of what exposures do not say. The mean over the views that are learnt from does not
        change.
        """
        centre = (self.gain * self.learned).sum(0) / self.learned.sum().clamp_min(1)
        gains: Tensor = self.known + (self.gain - centre) * self.learned
        return gains

    def forward(self, view: Annotated[Tensor, "R"]) -> Annotated[Tensor, "R 3"]:
        """Factors of views; of one that was never learnt from, what its exposure alone says."""
        at = view.to(self.gain.device)
        return torch.exp(
            self.gains().index_select(0, at) + self.exponent * self.exposure.index_select(0, at)[:, None]
        )

    def going_on(self, held: tuple[int, ...]) -> "Tones":
        """Tones that start as these are now, and learn from other views; the exponent stays."""
        tones = Tones(self.exposure, held)
        with torch.no_grad():
            tones.known.copy_(self.gains())
            tones.exponent.copy_(self.exponent).requires_grad_(False)
        return tones


def tones_of(facts: Facts) -> Tones | None:
    """Tones at their start; None where they are not learnt."""
    if facts.exposure:
        return Tones(torch.tensor(facts.exposure), facts.held)
    return None


def poses_of(facts: Facts, pace: float) -> Poses | None:
    """Poses as the capture says, to be learnt at a `pace`; None where they are not refined."""
    if not facts.centres:
        return None
    return Poses(torch.tensor(facts.centres, dtype=torch.float64), facts.held, reach=facts.reach, pace=pace)
