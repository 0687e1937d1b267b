"""Rays and projections: against OpenCV's own lenses, and against each other; tables, normals."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from analytic import plane_depth
from hypothesis import example, given
from hypothesis import strategies as st
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.rendering.cameras import (
    LIMIT,
    Cameras,
    PixelRays,
    grid_rays,
    normals,
    pixel_grid,
    project,
    rays_through,
)
from fprf.rendering.lens import FISHEYE, OPENCV, PINHOLE, bend, lens_reach, unbend
from fprf.rendering.paths import look_at, pinhole

K = {
    PINHOLE: (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    OPENCV: (0.0578421, -0.0805099, 0.01, -0.002, -0.000980296, 0.00015575),
    FISHEYE: (0.05, -0.01, 0.002, -0.0003, 0.0, 0.0),
}


def cameras(
    lenses: list[int],
    k: tuple[float, ...] | None = None,
    seed: int = 0,
    *,
    tiny: bool = False,
    offset: float = 0.0,
) -> Cameras:
    """Views of any pose and intrinsics, of 40 to 90 pixels across, or 5 to 12."""
    count = len(lenses)
    draw = torch.Generator().manual_seed(seed)
    turn, _ = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64, generator=draw))
    size = (
        torch.randint(5, 13, (count, 2), generator=draw)
        if tiny
        else torch.randint(40, 90, (count, 2), generator=draw)
    )
    return Cameras(
        pose=torch.cat(
            [turn * torch.linalg.det(turn)[:, None, None], offset + 5 * random(draw, count, 3, 1)], -1
        ),
        focal=(random(draw, count, 2) + 60) * (1 / 3 if tiny else 1),
        centre=size * 0.5 + random(draw, count, 2),
        size=size,
        distortion=torch.tensor([k or K[lens] for lens in lenses], dtype=torch.float64),
        lens=torch.tensor(lenses),
    )


def random(draw: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=draw)


def pixels(scene: Cameras, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    view = torch.randint(len(scene), (count,), generator=draw)
    return view, torch.rand(count, 2, dtype=torch.float64, generator=draw) * scene.size[view]


@given(st.lists(st.sampled_from([PINHOLE, OPENCV, FISHEYE]), min_size=1, max_size=5), st.integers(0, 99))
def test_a_point_on_a_ray_projects_to_its_pixel(lenses: list[int], seed: int) -> None:
    scene = cameras(lenses, seed=seed)
    view, pixel = pixels(scene, 64, seed)
    origin, direction = rays_through(scene, view, pixel)
    assert torch.allclose(direction.norm(dim=-1), torch.ones(64, dtype=torch.float64), atol=1e-14)
    again, depth = project(scene, view, origin + direction * 3.7)
    assert (again - pixel).abs().max() < 1e-9
    assert (depth > 0).all()


@given(
    st.sampled_from([OPENCV, FISHEYE]),
    st.tuples(*[st.floats(-0.25, 0.25)] * 3, st.floats(-0.05, 0.05), *[st.floats(-0.01, 0.01)] * 2),
)
@example(OPENCV, (0.25, 2.0e-288, 0.0, 1.1e-308, 0.0, 0.0))  # eigenvalues of so small ones do not converge
def test_any_lens_round_trips_up_to_its_reach(lens: int, k: tuple[float, ...]) -> None:
    scene = cameras([lens], k[:4] + ((0.0, 0.0) if lens == FISHEYE else k[4:]))
    view, pixel = pixels(scene, 64)
    origin, direction = rays_through(scene, view, pixel)
    assert torch.isfinite(direction).all()
    again, _ = project(scene, view, origin + direction)
    inside = (pixel - scene.centre).abs().amax(-1) < 8
    if not bool(scene.distortion[0, 4:].any()):  # tangential terms may fold before
        local = direction @ scene.pose[0, :, :3]
        angle = torch.atan2(local[:, :2].norm(dim=-1), -local[:, 2])
        inside |= (angle if lens == FISHEYE else angle.tan()) < 0.999 * scene.reach
    assert ((again - pixel)[inside].abs() < 1e-5).all()


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE])
def test_lenses_are_those_of_opencv(lens: int) -> None:
    k1, k2, k3, k4, p1, p2 = K[lens]
    # OpenCV's lens has k1 k2 p1 p2 k3; the fourth radial term is ours alone.
    scene = cameras([lens], (k1, k2, k3, k4 if lens == FISHEYE else 0.0, p1, p2))
    view, pixel = pixels(scene, 50)
    origin, direction = rays_through(scene, view, pixel)
    points = (origin + 2 * direction).numpy()[:, None]
    pose = scene.pose[0].numpy()
    rotation = (pose[:, :3] * [1, -1, -1]).T
    (fx, fy) = scene.focal[0].tolist()
    (cx, cy) = scene.centre[0].tolist()
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    own = cv2.fisheye.projectPoints if lens == FISHEYE else cv2.projectPoints
    bent = np.array([k1, k2, k3, k4] if lens == FISHEYE else [k1, k2, p1, p2, k3])
    expected, _ = own(points, cv2.Rodrigues(rotation)[0], -rotation @ pose[:, 3], matrix, bent)
    assert np.abs(expected[:, 0] - pixel.numpy()).max() < 1e-8


@pytest.mark.parametrize(
    ("lens", "k", "reach"),
    [
        (PINHOLE, (-1.0, 0.0, 0.0, 0.0), math.inf),
        (OPENCV, (0.1, 0.0, 0.0, 0.0), math.inf),
        (OPENCV, (0.0, 0.0, 0.0, -1 / 9), 1.0),
        (FISHEYE, (0.0, 0.0, 0.0, 0.0), math.pi),
        (FISHEYE, (-1 / 12, 0.0, 0.0, 0.0), 2.0),
    ],
)
def test_the_reach_is_where_the_radius_turns(lens: int, k: tuple[float, ...], reach: float) -> None:
    found = lens_reach(torch.tensor([(*k, 0.0, 0.0)], dtype=torch.float64), torch.tensor([lens]))
    assert found.item() == pytest.approx(reach, rel=1e-9)


def every_pixel(cameras: Cameras) -> tuple[Tensor, Tensor]:
    grids = [pixel_grid(cameras, v) for v in range(len(cameras))]
    return torch.cat([torch.full((len(g),), v) for v, g in enumerate(grids)]), torch.cat(grids)


def mixed(offset: float = 0.0) -> Cameras:
    """Five poses of four lenses, of one focal length and centre."""
    rig = cameras([PINHOLE, OPENCV, FISHEYE, OPENCV, PINHOLE], tiny=True, offset=offset)
    rig = replace(rig, focal=rig.focal[:1].repeat(5, 1), centre=rig.centre[:1].repeat(5, 1))
    return replace(rig.select(torch.tensor([0, 1, 2, 1, 4])), pose=rig.pose)


@pytest.mark.parametrize("offset", [0.0, 4.5e6])
@pytest.mark.parametrize("limit", [LIMIT, 0])
def test_every_pixel_of_mixed_cameras(offset: float, limit: int) -> None:
    rig = mixed(offset)
    rays = PixelRays(rig, limit=limit)
    view, pixel = every_pixel(rig)
    origin, direction = rays(view, pixel)
    wanted_origin, wanted = rays_through(rig, view, pixel)
    assert origin.dtype == direction.dtype == torch.float64
    assert torch.equal(origin, wanted_origin)
    assert (direction - wanted).abs().max() <= 1e-14
    assert (direction.norm(dim=-1) - 1).abs().max() <= 1e-14


@pytest.mark.parametrize("offset", [0.0, 4.5e6])
def test_many_pinholes_need_neither_a_table_nor_the_host(offset: float) -> None:
    rig = cameras([PINHOLE] * 3, tiny=True, offset=offset)
    rays = PixelRays(rig, limit=0)
    view, pixel = every_pixel(rig)
    origin, direction = rays_through(rig, view, pixel)
    assert rays.table is None and not rays.waits and PixelRays(mixed(), limit=0).waits
    with pretend_cuda() as seen:
        found = rays.to(CUDA)(view.to(CUDA), pixel.to(CUDA))
        assert not seen.syncs
        torch.testing.assert_close(found[0].cpu(), origin, rtol=0, atol=0)
        torch.testing.assert_close(found[1].cpu(), direction, rtol=0, atol=1e-14)


def test_resized_views_look_the_same_way() -> None:
    rig = mixed()
    larger = rig.resized(rig.size * torch.tensor([3, 2]))
    view, pixel = every_pixel(rig)
    torch.testing.assert_close(
        rays_through(larger, view, pixel * torch.tensor([3.0, 2.0])), rays_through(rig, view, pixel)
    )


def test_rays_of_whole_views_are_those_of_their_pixels() -> None:
    rig = mixed()
    for view in (0, 1, 2, 3, 1, 4):  # the last two lenses are remembered
        (origin, direction) = grid_rays(rig, view)
        (wanted_origin, wanted) = view_rays(rig, view)
        assert torch.equal(origin, wanted_origin) and (direction - wanted).abs().max() <= 1e-14


UP = torch.tensor([0.0, 0, 2], dtype=torch.float64)


def view_rays(cameras: Cameras, view: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    pixel = pixel_grid(cameras, view)
    return rays_through(cameras, torch.full((len(pixel),), view), pixel)


@pytest.fixture
def plain() -> Cameras:
    place, aim = (torch.tensor([p], dtype=torch.float64) for p in ((0.0, 0, 2), (5.0, 1, 1)))
    return pinhole(look_at(place, aim, UP), width=40, height=30, fov=60)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (-1.0, 0.2, 0.1), (-0.6, 0.0, 0.8)])
def test_a_plane_has_its_normal_everywhere(plain: Cameras, normal: tuple[float, float, float]) -> None:
    unit = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    depth = plane_depth(plain, 0, unit, float(unit @ torch.tensor([5.0, 0, 0], dtype=torch.float64)))
    found = normals(plain, 0, depth)
    seen = found.norm(dim=-1) > 0
    assert int(seen.sum()) >= 0.9 * int(torch.isfinite(depth).sum())
    assert torch.allclose(found[seen], unit.float().expand_as(found[seen]), atol=1e-4)
    assert not found[~torch.isfinite(depth)].any()


def test_whatever_the_depths_normals_face_the_camera(plain: Cameras) -> None:
    found = normals(plain, 0, torch.rand(30, 40, generator=torch.Generator().manual_seed(0)) * 3 + 0.1)
    _, direction = view_rays(plain)
    assert ((found.view(-1, 3).double() * direction).sum(-1) < 1e-6).all() and (
        found.norm(dim=-1) > 0.99
    ).all()


@pytest.mark.parametrize("k1", [-0.3, -1.0, 0.2])
def test_a_radius_that_hardly_grows_is_inverted(k1: float) -> None:
    """With k2 = 0.45 k1² the slope touches 0; above it Newton alone overshoots by far."""
    u = torch.cat([torch.linspace(0, 3, 301), torch.tensor([1e-9, 30.0, 1e4])]).double() / abs(k1) ** 0.5
    distortion = torch.tensor([[k1, 0.451 * k1 * k1, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(
        len(u), 6
    )
    lens = torch.full((len(u),), OPENCV)
    reach = lens_reach(distortion, lens)
    plane = torch.stack([u, torch.zeros_like(u)], 1)
    assert bool(reach.isinf().all())
    back = bend(distortion, lens, reach, unbend(distortion, lens, reach, plane))
    assert ((back - plane).abs() <= 1e-11 * (1 + u[:, None])).all()
