import math

import pytest
import torch
from analytic import RADIUS, globe, plane_depth, ring
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.export.depth_maps import DepthMaps, depth_gaps, surface_points
from fprf.rendering.cameras import pixel_grid, rays_through

angle = st.floats(-1.0, 1.0)


@settings(deadline=None)
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


def test_the_border_has_no_normals_and_all_else_has() -> None:
    cameras = ring(1, size=(9, 7))
    depth = torch.full((7, 9), 3.0)
    seen = surface_points(DepthMaps(cameras, (depth,)), 0)
    assert len(seen.point) == 7 * 5
    assert torch.allclose(seen.footprint, torch.full((35,), 3.0 / 50))


def test_normals_at_an_edge_are_those_of_the_pixels_own_surface() -> None:
    """Two planes, one twice as far: no normal mixes them, and every inner pixel has one."""
    cameras = ring(1, size=(12, 10))
    back = cameras.pose[0, :, 2]
    near = plane_depth(cameras, 0, back, float(back @ (cameras.pose[0, :, 3] - 3 * back)))
    far = plane_depth(cameras, 0, back, float(back @ (cameras.pose[0, :, 3] - 6 * back)))
    depth = torch.cat([near[:, :6], far[:, 6:]], 1)
    seen = surface_points(DepthMaps(cameras, (depth,)), 0)
    assert len(seen.point) == 10 * 8
    assert torch.allclose(seen.normal.double(), back.expand(80, 3), atol=1e-6)


def test_what_is_a_pixel_thin_faces_the_camera() -> None:
    cameras = ring(1, size=(9, 9))
    depth = torch.full((9, 9), torch.inf)
    depth[:, 4] = 2.0
    seen = surface_points(DepthMaps(cameras, (depth,)), 0)
    assert len(seen.point) == 7
    assert bool((seen.facing > 0.99).all())


def test_points_of_a_sphere_have_its_normals() -> None:
    maps = globe(3)
    for view in range(3):
        seen = surface_points(maps, view)
        straight = seen.facing > 0.5
        assert torch.allclose(seen.point.norm(dim=-1), torch.full((len(seen.point),), RADIUS, dtype=torch.float64), atol=1e-5)
        out = torch.nn.functional.normalize(seen.point, dim=-1)
        agree = (seen.normal.double() * out).sum(-1)[straight]
        # A chord of two pixels on a unit sphere, seen at 4/50 a pixel, turns by half a chord at most.
        assert float(agree.amin()) > math.cos(2 * 4 / 50)


@settings(deadline=None)
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


def test_a_view_sees_its_own_surface_at_no_gap() -> None:
    maps = globe(2, floor=-1.5)
    for view in range(2):
        gap, _ = depth_gaps(maps, view, surface_points(maps, view).point)
        assert float(gap.abs().amax()) < 1e-5


def test_gaps_outside_and_towards_the_sky() -> None:
    maps = globe(4)
    place = maps.cameras.pose[0, :, 3]
    _, corner = rays_through(maps.cameras, torch.tensor([0]), torch.tensor([[2.0, 2.0]]))
    points = torch.stack([2 * place, torch.zeros(3, dtype=torch.float64), place + 2 * corner[0]])
    gap, distance = depth_gaps(maps, 0, points)
    assert bool(gap[0].isnan()), "behind the camera"
    assert float(gap[1]) == pytest.approx(-RADIUS, abs=2e-3), "hidden inside the sphere"
    assert bool(gap[2].isinf()) and float(gap[2]) > 0, "floating before the sky"
    assert torch.allclose(distance, (points - place).norm(dim=-1))


def test_lookups_do_not_mix_two_surfaces() -> None:
    cameras = ring(1, size=(8, 6))
    depth = torch.full((6, 8), 2.0)
    depth[:, 4:] = 5.0
    pixel = torch.stack([torch.linspace(0.5, 7.5, 57, dtype=torch.float64), torch.full((57,), 3.2, dtype=torch.float64)], 1)
    origin, direction = rays_through(cameras, torch.zeros(57, dtype=torch.int64), pixel)
    gap, distance = depth_gaps(DepthMaps(cameras, (depth,)), 0, origin + direction)
    found = gap + distance
    assert bool(((found - 2).abs() < 1e-6).logical_or((found - 5).abs() < 1e-6).all())
    assert torch.equal(found < 3, pixel[:, 0] <= 4)
