"""Light through Gaussians: rays against ellipsoids in float64, and what must hold of any scene."""

import math
from typing import Annotated

import pytest
import torch
from torch import Tensor

from fprf.light.transport import (
    Blockers,
    axes_of,
    covariances_of,
    disc_directions,
    frame_of,
    openness,
    sky_directions,
    transport,
)
from fprf.ops.transport_kernels import MAX_ALPHA, MIN_ALPHA, MIN_LEFT

UP = torch.tensor([0.0, 0.0, 1.0])


def cloud(count: int, seed: int = 0) -> tuple[Blockers, Tensor]:
    """Gaussians of any shape in a unit cube, and their covariances [N 3 3] in float64."""
    draw = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=draw)
    turns = torch.randn(count, 4, generator=draw)
    sizes = -3.5 + 1.5 * torch.rand(count, 3, generator=draw)
    opacities = torch.rand(count, generator=draw)
    axes = axes_of(turns.double()) * sizes.double().exp()[:, None]
    return Blockers(means, covariances_of(turns, sizes), opacities), axes @ axes.transpose(1, 2)


def by_rays(
    blockers: Blockers, full: Tensor, points: Tensor, light: Tensor, offset: float, soft: float
) -> Annotated[Tensor, "M"]:
    """T by the least distance of each ray from each Gaussian, in its own standard deviations."""
    light = light.double() / light.double().norm()
    inverse = torch.linalg.inv(full)
    left = []
    for point in points.double():
        apart = blockers.means.double() - point
        # (point + t light - mean)^T C^-1 (...) is least at t.
        t = torch.einsum("a,nab,nb->n", light, inverse, apart) / torch.einsum(
            "a,nab,b->n", light, inverse, light
        )
        nearest = t[:, None] * light - apart
        alpha = (
            blockers.opacities.double()
            * (-0.5 * torch.einsum("na,nab,nb->n", nearest, inverse, nearest)).exp()
        )
        alpha = torch.where(alpha < MIN_ALPHA, 0.0, alpha.clamp_max(MAX_ALPHA)) * ((t - offset) / soft).clamp(
            0, 1
        )
        left.append((1 - alpha).prod())
    return torch.stack(left)


@pytest.mark.parametrize("light", [(0.0, 0.0, 1.0), (1.0, 0.2, 0.1), (-0.4, 0.7, 0.5)])
def test_transport_is_that_of_rays_against_ellipsoids(light: tuple[float, float, float]) -> None:
    blockers, full = cloud(400)
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(1))
    sun = torch.tensor(light)
    ones = torch.ones(len(points))
    found = transport(blockers, points, frame_of(sun), 0.05 * ones, 0.02 * ones)
    wanted = by_rays(blockers, full, points, sun, 0.05, 0.02)
    # Below MIN_LEFT the kernel stops. Positions are exact to u = 2^-24, exponents to 2 u d / s for d^2 < 11.1 and
    # sizes s > e^-3.5, and so the product of some 60 factors; an alpha at the cut may fall on either side.
    apart = (found - wanted).abs()
    assert float(apart.max()) < MIN_LEFT + MIN_ALPHA * 1.01
    assert float(apart.median()) < 60 * 2**-24 * 4 * math.sqrt(11.1) / math.exp(-3.5)
    assert 0.1 < float(wanted.mean()) < 0.9


def test_scene_and_sun_turned_together_are_lit_alike() -> None:
    blockers, full = cloud(500, seed=2)
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(3))
    turn = axes_of(torch.tensor([[0.3, -0.5, 0.7, 0.2]]).double())[0]
    turned = (turn @ full @ turn.T).flatten(1)[:, [0, 1, 2, 4, 5, 8]].float()
    moved = Blockers((blockers.means.double() @ turn.T).float(), turned, blockers.opacities)
    sun = torch.tensor([0.4, -0.3, 0.6]).double()
    ones = torch.ones(len(points))
    here = transport(blockers, points, frame_of(sun, UP), 0.02 * ones, 0.02 * ones)
    there = transport(
        moved,
        (points.double() @ turn.T).float(),
        frame_of(turn @ sun, turn @ UP.double()),
        0.02 * ones,
        0.02 * ones,
    )
    # Only a Gaussian at the cut of alpha, or one whose share of the light is nearly none, differs.
    assert float((here - there).abs().max()) < MIN_LEFT + 2 * MIN_ALPHA


def test_what_is_put_in_the_way_only_darkens() -> None:
    blockers, _ = cloud(300, seed=4)
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(5))
    ones = torch.ones(len(points))
    frame = frame_of(torch.tensor([0.2, 0.1, 1.0]))
    before = transport(Blockers(*(part[:200] for part in blockers)), points, frame, 0 * ones, 0.01 * ones)
    after = transport(blockers, points, frame, 0 * ones, 0.01 * ones)
    assert bool((after <= before + 1e-6).all()) and bool((after < before - 0.05).any())


def test_a_surface_does_not_shadow_itself_however_low_the_sun() -> None:
    """Flat Gaussians in a plane, of which each overlaps many."""
    at = torch.linspace(-1, 1, 30)
    means = torch.stack([*torch.meshgrid(at, at, indexing="ij"), torch.zeros(30, 30)], -1).view(-1, 3)
    sizes = torch.tensor([0.1, 0.1, 0.002]).log().expand(len(means), 3)
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    blockers = Blockers(means, covariances_of(turns, sizes), torch.full((len(means),), 0.9))
    ones = torch.ones(len(means))
    for degrees in (5.0, 30.0, 90.0):
        rise = math.radians(degrees)
        sun = torch.tensor([math.cos(rise), 0.0, math.sin(rise)])
        lit = transport(blockers, means, frame_of(sun), 0.05 * ones, 0.05 * ones)
        assert float(lit.min()) > 0.999
    below = transport(blockers, (means - 0.3 * UP), frame_of(UP), 0.05 * ones, 0.05 * ones)
    assert float(below.view(30, 30)[8:-8, 8:-8].max()) < 0.01


def test_shadows_of_a_wide_sun_are_softer_the_farther_they_fall() -> None:
    """Half a plane of flat Gaussians, and points below its edge at two depths."""
    x = torch.linspace(-2, 0, 120)
    y = torch.linspace(-1, 1, 120)
    means = torch.stack([*torch.meshgrid(x, y, indexing="ij"), torch.zeros(120, 120)], -1).view(-1, 3)
    sizes = torch.tensor([0.02, 0.02, 0.002]).log().expand(len(means), 3)
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    blockers = Blockers(means, covariances_of(turns, sizes), torch.full((len(means),), 0.95))
    places = disc_directions(UP, torch.tensor([0.0, 1, 0]), 5.0, 64)
    widths = []
    for depth in (1.0, 4.0):
        line = torch.linspace(-0.5, 0.5, 201)
        points = torch.stack([line, torch.zeros(201), torch.full((201,), -depth)], 1)
        ones = torch.ones(201)
        lit = torch.zeros(201)
        for place in places:
            lit += transport(blockers, points, frame_of(place), 0.1 * ones, 0.1 * ones) / len(places)
        assert bool((lit.diff() > -0.05).all())
        widths.append(float(((lit > 0.1) & (lit < 0.9)).float().mean()))
    assert 3.0 < widths[1] / widths[0] < 5.0


def test_sky_directions_are_spread_about_up() -> None:
    up = torch.nn.functional.normalize(torch.tensor([0.3, -0.9, 0.2]), dim=0)
    found = sky_directions(up)
    assert torch.allclose(found.norm(dim=1), torch.ones(len(found)).double())
    assert float((found @ up.double()).min()) > 0.1
    level = found.mean(0) - (found.mean(0) @ up.double()) * up.double()
    assert float(level.norm()) < 0.1


def test_openness_is_that_of_what_stands_around() -> None:
    nothing = Blockers(torch.zeros(0, 3), torch.zeros(0, 6), torch.zeros(0))
    point = torch.zeros(1, 3)
    ones = torch.ones(1)
    assert float(openness(nothing, point, UP[None], UP, 0.1 * ones, 0.1 * ones)) == pytest.approx(1.0)
    at = torch.linspace(-3, 3, 60)
    wall = torch.stack([torch.full((60, 60), 0.5), *torch.meshgrid(at, at, indexing="ij")], -1).view(-1, 3)
    sizes = torch.tensor([0.01, 0.1, 0.1]).log().expand(len(wall), 3)
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(wall), 4)
    blockers = Blockers(wall, covariances_of(turns, sizes), torch.full((len(wall),), 0.95))
    half = float(openness(blockers, point, UP[None], UP, 0.1 * ones, 0.1 * ones))
    assert 0.4 < half < 0.65


@pytest.mark.parametrize("blur", [0.0, 0.03])
def test_long_needles_are_no_fault(blur: float) -> None:
    # The product of their widths across the light is the difference of two numbers a thousand million times as large.
    draw = torch.Generator().manual_seed(0)
    turns = torch.randn(4000, 4, generator=draw)
    sizes = torch.tensor([5.3, -9.0, -9.0]).repeat(4000, 1)
    needles = Blockers(
        torch.randn(4000, 3, generator=draw), covariances_of(turns, sizes), torch.full((4000,), 0.9)
    )
    points = torch.randn(50, 3, generator=draw) - torch.tensor([0.0, 0.0, 5.0])
    ones = torch.full((50,), 0.01)
    for light in torch.nn.functional.normalize(torch.randn(8, 3, generator=draw), dim=1):
        found = transport(needles, points, frame_of(light), ones, ones, blur)
        assert bool(found.isfinite().all()) and float(found.min()) >= 0 and float(found.max()) <= 1
