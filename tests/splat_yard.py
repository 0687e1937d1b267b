"""A yard of Gaussians with z up: level ground, a house and a tree."""

import numpy as np
import torch

from fprf.ops.harmonics import HARMONIC
from fprf.splats.gaussians import Gaussians


def yard(count: int = 4000, *, seed: int = 0) -> Gaussians:
    """Half of it ground at z = 0 within 3 of the middle, all else above; colours of degree 0."""
    draw = np.random.default_rng(seed)
    ground = count // 2
    angle = draw.uniform(0, 2 * np.pi, ground)
    away = 3 * np.sqrt(draw.random(ground))
    points = [np.stack([away * np.cos(angle), away * np.sin(angle), 0.03 * draw.normal(size=ground)], 1)]
    walls = count // 4
    side = draw.integers(0, 4, walls)
    along = draw.uniform(-0.8, 0.8, walls)
    x = np.where(side < 2, np.where(side == 0, -0.8, 0.8), along)
    y = np.where(side < 2, along, np.where(side == 2, -0.8, 0.8))
    points.append(np.stack([x, y, draw.uniform(0, 1.2, walls)], 1))
    leaves = count - ground - walls
    ways = draw.normal(size=(leaves, 3))
    ways *= draw.random((leaves, 1)) ** 0.3 / np.linalg.norm(ways, axis=1, keepdims=True)
    points.append(np.array([1.9, 0.6, 1.5]) + 0.5 * ways)
    means = torch.from_numpy(np.concatenate(points)).float()
    sizes = torch.full((count, 3), float(np.log(0.05)))
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    colours = torch.tensor(
        [[0.25, 0.5, 0.2]] * ground + [[0.75, 0.3, 0.25]] * walls + [[0.85, 0.75, 0.2]] * leaves
    )
    colours = (colours + 0.06 * torch.from_numpy(draw.normal(size=(count, 3))).float()).clamp(0, 1)
    return Gaussians(means, turns, sizes, torch.full((count,), 3.0), ((colours - 0.5) / HARMONIC)[:, None])


def with_up(made: Gaussians, up: str) -> Gaussians:
    """The yard turned so that its z axis becomes +z, -z, +y or -y; spheres need no turn of their own."""
    x, y, z = made.means.T
    turned = {"+z": (x, y, z), "-z": (x, -y, -z), "+y": (x, z, -y), "-y": (x, -z, y)}[up]
    means = torch.stack(turned, 1)
    return Gaussians(means, made.quaternions, made.log_scales, made.logits, made.harmonics)
