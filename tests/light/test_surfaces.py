"""Surfaces of Gaussians: planes are found, also where nothing on them holds Gaussians in their place."""

import math

import torch

from fprf.light.surfaces import find_surfaces
from fprf.ops.rasterise.rendering import Pinhole

UP = torch.tensor([0.0, 0.0, 1.0])


def looking_down(x: float, slope: float) -> Pinhole:
    """A camera two units above the plane z = 0, which looks ahead along y and down."""
    world = torch.eye(4, dtype=torch.float64)
    ahead = torch.nn.functional.normalize(torch.tensor([0.0, 1.0, -slope]).double(), dim=0)
    right = torch.tensor([1.0, 0, 0]).double()
    world[:3, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
    world[:3, 3] = -world[:3, :3] @ torch.tensor([x, -3.0, 2.0]).double()
    return Pinhole(torch.tensor([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]), world, 160, 120, 0.1)


def test_a_road_that_lies_too_deep_takes_the_plane_of_its_markings() -> None:
    """Small Gaussians in stripes on a plane; between them wide ones, far below it."""
    draw = torch.Generator().manual_seed(0)
    stripe = torch.rand(6000, 3, generator=draw) * torch.tensor([8.0, 8.0, 0.0]) - torch.tensor(
        [4.0, 3.0, 0.0]
    )
    stripe = stripe[(stripe[:, 0] * 1.5).floor() % 2 == 0]
    deep = torch.rand(300, 3, generator=draw) * torch.tensor([30.0, 30.0, 1.0]) - torch.tensor(
        [15.0, 6.0, 4.0]
    )
    means = torch.cat([stripe, deep])
    sizes = torch.cat(
        [torch.full((len(stripe), 3), math.log(0.06)), torch.full((len(deep), 3), math.log(1.5))]
    )
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    logits = torch.full((len(means),), 2.0)
    cameras = [looking_down(x, 0.5) for x in (-1.0, 0.0, 1.0)]
    found = find_surfaces(means, turns, sizes, logits, cameras, up=UP)
    road = torch.arange(len(means)) >= len(stripe)
    shown = road & (found.weights > 30)
    assert int(shown.sum()) > 20
    assert float(found.normals[shown][:, 2].mean()) > 0.95
    assert float(found.points[shown][:, 2].abs().median()) < 0.3 < float(means[shown][:, 2].abs().median())
    assert float(found.normals[~road & (found.weights > 1)][:, 2].mean()) > 0.95


def test_normals_point_out_of_a_ball_and_what_no_view_shows_counts_nothing() -> None:
    draw = torch.Generator().manual_seed(1)
    means = torch.nn.functional.normalize(torch.randn(4000, 3, generator=draw), dim=1)
    means = torch.cat([means, 0.2 * means[:50]])
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    sizes = torch.full((len(means), 3), math.log(0.05))
    logits = torch.full((len(means),), 4.0)
    cameras = []
    for quarter in range(4):
        turn = quarter * math.pi / 2
        ahead = -torch.tensor([math.cos(turn), math.sin(turn), 0.0]).double()
        right = torch.linalg.cross(ahead, UP.double())
        world = torch.eye(4, dtype=torch.float64)
        world[:3, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead])
        world[:3, 3] = world[:3, :3] @ (3 * ahead)
        cameras.append(Pinhole(torch.tensor([[150.0, 0, 80], [0, 150, 80], [0, 0, 1]]), world, 160, 160, 0.1))
    found = find_surfaces(means, turns, sizes, logits, cameras, up=UP)
    level = (means[:4000, 2].abs() < 0.5) & (found.weights[:4000] > 1)
    cosine = (found.normals[:4000] * means[:4000]).sum(1)[level]
    assert float(cosine.median()) > 0.95 and float(cosine.quantile(0.05)) > 0.7
    inside = found.weights[4000:] < 1e-2
    assert bool(inside.any())
    assert bool((found.sure[4000:][inside] == 0).all()) and torch.equal(
        found.points[4000:][inside], means[4000:][inside]
    )


def test_points_beside_an_outline_lie_on_one_of_its_sides() -> None:
    """A card before a wall: no plane fits both, and what other views show without the outline counts more."""
    draw = torch.Generator().manual_seed(2)
    square = 2 * torch.rand(12000, 2, generator=draw) - 1
    card = torch.cat([square[:4000] * 0.6, torch.full((4000, 1), 1.0)], 1)
    wall = torch.cat([square[4000:] * 2.2, torch.zeros(8000, 1)], 1)
    means = torch.cat([card, wall])
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    sizes = torch.tensor([0.03, 0.03, 0.003]).log().expand(len(means), 3)
    logits = torch.full((len(means),), 4.0)
    cameras = []
    for x in (-1.6, -0.8, 0.0, 0.8, 1.6):
        world = torch.eye(4, dtype=torch.float64)
        world[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]).double()
        world[:3, 3] = -world[:3, :3] @ torch.tensor([x, 0.0, 4.0]).double()
        cameras.append(Pinhole(torch.tensor([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]), world, 160, 120, 0.1))
    found = find_surfaces(means, turns, sizes, logits, cameras, up=UP)
    shown = found.weights > 1
    off = (found.points - means)[:, 2].abs()
    assert float(off[shown].quantile(0.9)) < 0.03
    assert float(found.normals[shown][:, 2].quantile(0.1)) > 0.9
