"""Rays and projections: against OpenCV's own lenses, and against each other."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.rendering.cameras import Cameras, project, rays_through, sees
from fprf.rendering.lens import FISHEYE, OPENCV, PINHOLE, lens_reach

QUICK = settings(max_examples=25, deadline=None)
K = {
    PINHOLE: (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    OPENCV: (0.0578421, -0.0805099, 0.01, -0.002, -0.000980296, 0.00015575),
    FISHEYE: (0.05, -0.01, 0.002, -0.0003, 0.0, 0.0),
}


def cameras(lenses: list[int], distortion: list[tuple[float, ...]] | None = None, seed: int = 0) -> Cameras:
    count = len(lenses)
    draw = torch.Generator().manual_seed(seed)
    turn, _ = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64, generator=draw))
    turn = turn * torch.linalg.det(turn)[:, None, None]
    place = 5 * torch.randn(count, 3, 1, dtype=torch.float64, generator=draw)
    width = torch.randint(40, 90, (count,), generator=draw)
    height = torch.randint(30, 70, (count,), generator=draw)
    size = torch.stack([width, height], -1)
    return Cameras(
        pose=torch.cat([turn, place], -1),
        focal=torch.rand(count, 2, dtype=torch.float64, generator=draw) * 10 + 60,
        centre=size * 0.5 + torch.randn(count, 2, dtype=torch.float64, generator=draw),
        size=size,
        distortion=torch.tensor(distortion or [K[lens] for lens in lenses], dtype=torch.float64),
        lens=torch.tensor(lenses),
    )


def pixels(scene: Cameras, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    draw = torch.Generator().manual_seed(seed)
    view = torch.randint(len(scene), (count,), generator=draw)
    return view, torch.rand(count, 2, dtype=torch.float64, generator=draw) * scene.size[view]


@QUICK
@given(st.lists(st.sampled_from([PINHOLE, OPENCV, FISHEYE]), min_size=1, max_size=5), st.integers(0, 99))
def test_a_point_on_a_ray_projects_to_its_pixel(lenses: list[int], seed: int) -> None:
    scene = cameras(lenses, seed=seed)
    view, pixel = pixels(scene, 64, seed)
    origin, direction = rays_through(scene, view, pixel)
    assert torch.allclose(direction.norm(dim=-1), torch.ones(64, dtype=torch.float64), atol=1e-14)
    again, depth = project(scene, view, origin + direction * 3.7)
    assert (again - pixel).abs().max() < 1e-9
    assert (depth > 0).all()
    assert sees(scene, view, pixel).all()


@QUICK
@given(
    st.sampled_from([OPENCV, FISHEYE]),
    st.tuples(*[st.floats(-0.25, 0.25)] * 3, st.floats(-0.05, 0.05), *[st.floats(-0.01, 0.01)] * 2),
)
def test_any_lens_round_trips_where_it_sees_and_says_where_it_does_not(lens: int, k: tuple[float, ...]) -> None:
    scene = cameras([lens], [k[:4] + ((0.0, 0.0) if lens == FISHEYE else k[4:])])
    view, pixel = pixels(scene, 64)
    origin, direction = rays_through(scene, view, pixel)
    assert torch.isfinite(direction).all()
    seen = sees(scene, view, pixel)
    again, _ = project(scene, view[seen], (origin + direction)[seen])
    inside = torch.isfinite(again).all(-1)
    assert (again - pixel[seen])[inside].abs().max() < 1e-5 if inside.any() else True
    near_axis = (pixel - scene.centre).abs().max(-1).values < 8
    assert seen[near_axis].all()


def test_axes_are_opengl_s() -> None:
    scene = Cameras(
        pose=torch.eye(3, 4, dtype=torch.float64)[None],
        focal=torch.full((1, 2), 10.0, dtype=torch.float64),
        centre=torch.full((1, 2), 5.0, dtype=torch.float64),
        size=torch.tensor([[10, 10]]),
        distortion=torch.zeros(1, 6, dtype=torch.float64),
        lens=torch.zeros(1, dtype=torch.int64),
    )
    corners = torch.tensor([[5.0, 5.0], [10.0, 5.0], [5.0, 0.0]])
    _, direction = rays_through(scene, torch.zeros(3, dtype=torch.int64), corners)
    assert direction[0].tolist() == [0.0, 0.0, -1.0]
    assert direction[1, 0] > 0 and direction[1, 1] == 0
    assert direction[2, 1] > 0 and direction[2, 0] == 0


def test_the_opencv_lens_is_opencv_s() -> None:
    # OpenCV has k1 k2 p1 p2 k3; the fourth radial term is ours alone.
    k1, k2, k3, _, p1, p2 = K[OPENCV]
    scene = cameras([OPENCV], [(k1, k2, k3, 0.0, p1, p2)])
    view, pixel = pixels(scene, 50)
    origin, direction = rays_through(scene, view, pixel)
    expected, _ = cv2.projectPoints((origin + 2 * direction).numpy(), *_opencv_pose(scene), np.array([k1, k2, p1, p2, k3]))
    assert np.abs(expected[:, 0] - pixel.numpy()).max() < 1e-8


def test_the_fisheye_is_opencv_s() -> None:
    scene = cameras([FISHEYE])
    view, pixel = pixels(scene, 50)
    origin, direction = rays_through(scene, view, pixel)
    rotation, translation, matrix = _opencv_pose(scene)
    points = (origin + 2 * direction).numpy()[:, None]
    expected, _ = cv2.fisheye.projectPoints(points, rotation, translation, matrix, np.array(K[FISHEYE][:4]))
    assert np.abs(expected[:, 0] - pixel.numpy()).max() < 1e-8


def _opencv_pose(scene: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pose = scene.pose[0].numpy()
    rotation = (pose[:, :3] * [1, -1, -1]).T
    (fx, fy), (cx, cy) = scene.focal[0].tolist(), scene.centre[0].tolist()
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return cv2.Rodrigues(rotation)[0], -rotation @ pose[:, 3], matrix


def test_a_fisheye_sees_behind_its_image_plane() -> None:
    scene = cameras([FISHEYE], [(0.0,) * 6])
    angle = 2.0
    pixel = scene.centre + torch.tensor([[angle, 0.0]]) * scene.focal
    view = torch.zeros(1, dtype=torch.int64)
    origin, direction = rays_through(scene, view, pixel)
    again, depth = project(scene, view, origin + direction)
    assert torch.allclose(again, pixel, atol=1e-10)
    assert depth.item() == pytest.approx(math.cos(angle))


def test_barrel_distortion_leaves_corners_that_see_nothing() -> None:
    # k1 = -0.3: r (1 - 0.3 r²) turns at r = 1.054 and never exceeds 0.703 focal lengths.
    scene = cameras([OPENCV], [(-0.3, 0.0, 0.0, 0.0, 0.0, 0.0)])
    reach = math.sqrt(1 / 0.9)
    assert scene.reach.item() == pytest.approx(reach, rel=1e-12)
    rim = reach * (1 - 0.3 * reach**2)
    view = torch.zeros(2, dtype=torch.int64)
    pixel = scene.centre + torch.tensor([[rim * 0.999, 0.0], [rim * 1.01, 0.0]]) * scene.focal
    assert sees(scene, view, pixel).tolist() == [True, False]
    # A millionth of a pixel decides, in pixels of this view.
    beyond = torch.tensor([[0.0], [0.9e-6], [1.5e-6], [1e-4]], dtype=torch.float64)
    at_rim = scene.centre + torch.tensor([[rim, 0.0]], dtype=torch.float64) * scene.focal + beyond * torch.tensor([1.0, 0.0])
    assert sees(scene, torch.zeros(4, dtype=torch.int64), at_rim).tolist() == [True, True, False, False]
    _, direction = rays_through(scene, view, pixel)
    forward = -(direction @ scene.pose[0, :, 2])
    assert forward[1].item() == pytest.approx(1 / math.hypot(1, reach), rel=1e-9)


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


def test_points_behind_a_camera_have_no_pixel() -> None:
    scene = cameras([PINHOLE, OPENCV])
    view, pixel = pixels(scene, 8)
    origin, direction = rays_through(scene, view, pixel)
    behind, depth = project(scene, view, origin - direction)
    assert behind.isnan().all() and (depth < 0).all()


@QUICK
@given(st.integers(1, 9), st.integers(0, 99))
def test_scaling_commutes_with_rays(factor: int, seed: int) -> None:
    scene = cameras([PINHOLE, OPENCV, FISHEYE], seed=seed)
    small = scene.scaled(factor)
    assert torch.equal(small.size, (scene.size / factor).round().clamp_min(1).long())
    view, pixel = pixels(scene, 32, seed)
    ratio = small.size[view] / scene.size[view].double()
    for one, other in zip(rays_through(scene, view, pixel), rays_through(small, view, pixel * ratio), strict=True):
        assert torch.allclose(one, other, atol=1e-12)


def test_something_is_left_of_the_smallest_image() -> None:
    scene = cameras([PINHOLE, OPENCV])
    assert torch.equal(scene.scaled(1e4).size, torch.ones(2, 2, dtype=torch.int64))


def test_select_takes_views_in_order() -> None:
    scene = cameras([PINHOLE, OPENCV, FISHEYE])
    some = scene.select(torch.tensor([2, 0]))
    assert some.lens.tolist() == [FISHEYE, PINHOLE] and len(some) == 2
    view, pixel = pixels(scene, 16)
    keep = (view == 2) | (view == 0)
    renumbered = torch.where(view[keep] == 2, 0, 1)
    whole = rays_through(scene, view[keep], pixel[keep])
    part = rays_through(some, renumbered, pixel[keep])
    assert all(torch.equal(a, b) for a, b in zip(whole, part, strict=True))


def test_no_rays_are_no_rays() -> None:
    scene = cameras([OPENCV, FISHEYE])
    none = torch.zeros(0, dtype=torch.int64)
    origin, direction = rays_through(scene, none, torch.zeros(0, 2))
    assert origin.shape == direction.shape == (0, 3)
    assert project(scene, none, origin)[0].shape == (0, 2)
