"""Scenes without images: cameras over a plane or along a path, and points that they see; rows of blocks."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from fprf.blocks.routing import surroundings_of
from fprf.datamanagers.scene import ParsedScene
from fprf.rendering.cameras import Cameras
from fprf.rendering.paths import pinhole
from fprf.types import Cell


def cameras_at(position: Tensor, ahead: Tensor, upright: Tensor, size: tuple[int, int] = (64, 48)) -> Cameras:
    """Pinholes of 90 degrees at positions [V 3], looking ahead [V 3]."""
    back = -ahead / ahead.norm(dim=-1, keepdim=True)
    right = torch.nn.functional.normalize(torch.linalg.cross(upright.expand_as(back), back), dim=-1)
    pose = torch.stack([right, torch.linalg.cross(back, right), back, position], -1)
    return pinhole(pose, width=size[0], height=size[1], fov=math.degrees(2 * math.atan(size[1] / size[0])))


def scene_of(cameras: Cameras, points: Tensor | None, seen: Tensor | None = None) -> ParsedScene:
    """Every 8th view held out."""
    index = torch.arange(len(cameras))
    return ParsedScene(
        name="scene",
        paths=tuple(Path(f"{k:04d}.png") for k in index.tolist()),
        cameras=cameras,
        train=index[index % 8 != 0],
        test=index[index % 8 == 0],
        points=points,
        seen=seen,
    )


def street(length: float = 100.0, views: int = 40, walls: int = 4000) -> ParsedScene:
    """Along x at 2 m above the ground, looking ahead; walls at y = -6 and 6, 8 m high."""
    draw = torch.Generator().manual_seed(0)
    x = torch.linspace(0, length, views, dtype=torch.float64)
    position = torch.stack([x, 0.2 * torch.sin(x), torch.full_like(x, 2.0)], 1)
    ahead = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(views, 3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    points = (
        torch.rand(walls, 3, dtype=torch.float64, generator=draw)
        * torch.tensor([length + 30, 2.0, 8.0]).double()
    )
    points[:, 1] = torch.where(points[:, 1] > 1, 6.0, -6.0)
    return scene_of(cameras_at(position, ahead, up), points)


def drone(side: float = 90.0, rows: int = 7, height: float = 30.0, points: int = 6000) -> ParsedScene:
    """A square survey, looking straight down, each flight line the other way round; ground at z = 0."""
    draw = torch.Generator().manual_seed(0)
    way = torch.linspace(0, side, rows, dtype=torch.float64)
    x, y = torch.meshgrid(way, way, indexing="ij")
    position = torch.stack([x.flatten(), y.flatten(), torch.full((rows * rows,), height).double()], 1)
    ahead = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64).expand(len(position), 3)
    north = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    ground = (
        torch.rand(points, 3, dtype=torch.float64, generator=draw)
        * torch.tensor([side + 20, side + 20, 4.0]).double()
    )
    ground[:, :2] -= 10
    return scene_of(cameras_at(position, ahead, north), ground)


def cell(low: Sequence[float], high: Sequence[float], border: float) -> Cell:
    corners = (torch.tensor(corner, dtype=torch.float64) for corner in (low, high, [border] * 3))
    return Cell(**dict(zip(("low", "high", "border"), corners, strict=True)))


def row(count: int, border: float = 0.3) -> list[Cell]:
    """Cells side by side along axis 0."""
    return [cell((2.0 * i, -1.0, 0.0), (2.0 * i + 2.0, 1.0, 1.5), border) for i in range(count)]


def grid(columns: int, rows: int, border: float = 0.2) -> list[Cell]:
    """Unit cubes."""
    return [cell((i, j, 0.0), (i + 1.0, j + 1.0, 1.0), border) for i in range(columns) for j in range(rows)]


def points_around(cells: Sequence[Cell], count: int, seed: int = 5) -> Tensor:
    """Uniform in the bounds of all blocks, widened by 1."""
    whole = surroundings_of(cells)
    draw = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return (whole.low - 1 + draw * (whole.high - whole.low + 2)).float()
