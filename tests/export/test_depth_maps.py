"""Depth maps, the surfaces in them, and the gaps between points and surfaces."""

import math

import pytest
import torch
from analytic import plane_depth, ring
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.export.colours import Coloured, point_colours, single_view
from fprf.export.depth_maps import DepthMaps, depth_gaps, ray_quantile, render_depth_maps, surface_points
from fprf.plugins.stylizers.config import RegionOtConfig
from fprf.rendering.cameras import grid_rays, pixel_grid, rays_through
from fprf.style.look import Restyle
from fprf.style.restyle import restyle
from fprf.training.views import render_view

angle = st.floats(-1.0, 1.0)


@given(tilt=angle, turn=angle)
def test_normals_of_a_plane_are_exact(tilt: float, turn: float) -> None:
    """Points of a plane stay on it, so that steps between them lie in it whatever the perspective."""
    cameras = ring(1, size=(12, 10))
    towards = -cameras.pose[0, :, 2]
    normal = cameras.pose[0, :, :3] @ torch.tensor([math.sin(tilt), math.sin(turn), 1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    offset = float(normal @ (cameras.pose[0, :, 3] + 4 * towards))
    depth = plane_depth(cameras, 0, normal, offset)
    seen = surface_points(DepthMaps(cameras, (depth,)), 0)
    assert len(seen.point) > 0
    assert torch.allclose(seen.point @ normal, torch.full((len(seen.point),), offset, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(seen.normal.double(), normal.expand(len(seen.normal), 3), atol=1e-5)
    way = torch.nn.functional.normalize(cameras.pose[0, :, 3] - seen.point, dim=-1)
    assert torch.allclose(seen.facing.double(), way @ normal, atol=1e-5)


@given(offset=st.floats(-0.5, 0.5))
def test_the_gap_is_how_far_in_front_of_the_surface_a_point_is(offset: float) -> None:
    cameras = ring(1, size=(20, 16))
    back = cameras.pose[0, :, 2]
    depth = plane_depth(cameras, 0, back, float(back @ (cameras.pose[0, :, 3] - 3 * back)))
    pixel = pixel_grid(cameras, 0)[::3] + 0.31
    inner = ((pixel > 1) & (pixel < cameras.size[0] - 1)).all(-1)
    origin, direction = rays_through(cameras, torch.zeros(int(inner.sum()), dtype=torch.int64), pixel[inner])
    there = 3 / -(direction @ back)
    gap, distance = depth_gaps(DepthMaps(cameras, (depth,)), 0, origin + direction * (there - offset)[:, None])
    # 1/distance of a plane is linear up to the cosine's curvature over a pixel, (1/focal)^2 / 8 of it a direction.
    assert torch.allclose(gap, torch.full_like(gap, offset), atol=3 * 3 / 4 / 50**2)
    assert torch.allclose(distance, there - offset, atol=1e-9)


@given(seed=st.integers(0, 2**31), share=st.floats(0.05, 0.95))
def test_half_way_is_where_that_much_weight_has_been_met(seed: int, share: float) -> None:
    """Against weight spread finely over each step, in float64."""
    draw = torch.Generator().manual_seed(seed)
    t = torch.rand(4, 9, generator=draw, dtype=torch.float64).cumsum(1)
    weights = torch.rand(4, 8, generator=draw, dtype=torch.float64) + 1e-3
    weights /= weights.sum(1, keepdim=True)
    found = ray_quantile(weights, t, torch.full((4,), share, dtype=torch.float64))
    for ray in range(4):
        part = ((found[ray] - t[ray, :-1]) / (t[ray, 1:] - t[ray, :-1])).clamp(0, 1)
        assert float((weights[ray] * part).sum()) == pytest.approx(share, abs=1e-9)


def test_depth_maps_are_world_distances_at_a_bounded_size(world: World) -> None:
    trained = world.load()
    known, render = trained.known, trained.config.render
    views = known.train[:2]
    whole = render_depth_maps(trained.model, known.cameras, views, render, side=400, reach=math.inf)
    assert [tuple(d.shape) for d in whole.depth] == [(24, 32)] * 2
    half = render_depth_maps(trained.model, known.cameras, views, render, side=16, reach=math.inf)
    assert [tuple(d.shape) for d in half.depth] == [(12, 16)] * 2
    assert torch.equal(half.cameras.focal, whole.cameras.focal / 2)
    assert torch.equal(whole.cameras.pose, known.cameras.pose[list(views)])
    near = render_depth_maps(trained.model, known.cameras, views, render, side=400, reach=3.0)
    for every, some in zip(whole.depth, near.depth, strict=True):
        assert bool((every[every.isfinite()] > 0).all())
        assert torch.equal(some, torch.where(every < 3.0, every, torch.inf))
    mean = render_view(trained.model, known.facts, known.cameras, views[0], render).depth
    solid = whole.depth[0].isfinite()
    # Half of the weight and the mean of it lie on the same side of a ray: their medians over an image agree roughly.
    ratio = (whole.depth[0] / mean)[solid]
    assert 0.5 < float(ratio.median()) < 1.5


def test_points_on_rays_of_pixels_have_the_colours_of_the_picture(world: World) -> None:
    """At any distance along the ray, and one set for each style."""
    trained = world.load()
    known, render = trained.known, trained.config.render
    origin, direction = grid_rays(known.cameras, 1)
    points = origin + direction * (1 + torch.rand(len(origin), 1))
    styled = restyle(trained, world.references, RegionOtConfig()).restyle
    told: list[tuple[int, int]] = []
    seen = single_view(torch.full((len(points),), 1))
    [plain, full, none], presence = point_colours(
        trained.model, known.facts, known.cameras, points, seen, render, [None, styled, Restyle(styled.stylizer, 0.0)],
        tolerance=None, report=lambda done, total: told.append((done, total)),
    )  # fmt: skip
    picture, styled_picture = (render_view(trained.model, known.facts, known.cameras, 1, render, s) for s in (None, styled))
    # The ray's direction is found again from a point on it, and a sample may then cross the error budget.
    assert float((plain - picture.rgb.view(-1, 3)).abs().amax()) < 5e-3
    assert float((full - styled_picture.rgb.view(-1, 3)).abs().amax()) < 5e-3
    assert float((presence - picture.opacity.view(-1)).abs().amax()) < 5e-3
    assert torch.equal(plain, none) and float((plain - full).abs().mean()) > 0.01
    assert told[-1] == (len(points), len(points))


def test_near_a_point_nothing_else_of_its_rays_is_seen(world: World) -> None:
    """Presence is what an interval of the ray holds: it grows with the tolerance, and is small in the empty air."""
    trained = world.load()
    known, render = trained.known, trained.config.render
    maps = render_depth_maps(trained.model, known.cameras, known.train[:1], render, side=400, reach=math.inf)
    origin, direction = grid_rays(maps.cameras, 0)
    depth = maps.depth[0].view(-1, 1).double()
    there = depth[:, 0].isfinite()

    def look(away: float, tolerance: float | None, styles: int = 1) -> Coloured:
        points = (origin + direction * depth * away)[there]
        seen = single_view(torch.zeros(len(points), dtype=torch.int64))
        return point_colours(
            trained.model, known.facts, maps.cameras, points, seen, render, [None] * styles, tolerance=tolerance
        )

    narrow, wide, air = look(1, 0.1).presence, look(1, 0.5).presence, look(0.2, 0.1).presence
    assert bool((wide > narrow - 0.02).all()) and float(wide.mean()) > float(narrow.mean()) > 3 * float(air.mean())
    one, two = look(1, 0.5, 2).colours
    assert torch.equal(one, two) and bool((one >= 0).all()) and bool((one <= 1).all())
    whole = look(1, None).colours[0]
    assert float((one - whole).abs().mean()) < 0.15, "a wide interval holds most of what the ray shows"
    lost = look(1e-3, 1e-6)
    assert bool((lost.presence < 1e-3).all())
    assert float((lost.colours[0] - whole).abs().amax()) < 0.02, "where nothing is the whole ray's colour stands in"
