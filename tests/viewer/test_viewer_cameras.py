import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.errors import UsageError
from fprf.rendering.cameras import project
from fprf.rendering.paths import pinhole
from fprf.rendering.space import Space
from fprf.types import Cell
from fprf.viewer.cameras import (
    CameraState,
    PageTransform,
    box_edges,
    camera_frustums,
    checked_camera,
    page_transform,
    path_segments,
    picture_size,
)


def test_a_captured_camera_goes_to_the_page_and_back(world: World) -> None:
    cameras = world.load().known.cameras
    transform = page_transform(cameras)
    for view in range(len(cameras)):
        width, height = (int(v) for v in cameras.size[view])
        back = transform.cameras([transform.camera_state(cameras, view)], (width, height))
        assert torch.allclose(back.pose[0], cameras.pose[view], atol=1e-9)
        assert torch.allclose(back.focal[0], cameras.focal[view, 1].repeat(2), atol=1e-9)


def test_far_from_the_origin_nothing_is_lost(world: World) -> None:
    cameras = world.load().known.cameras
    shift = torch.tensor([4.5e6, -3.0e5, 120.0], dtype=torch.float64)
    far = replace(cameras, pose=torch.cat([cameras.pose[:, :, :3], cameras.pose[:, :, 3:] + shift[:, None]], -1))
    here, there = page_transform(cameras).camera_state(cameras, 3), page_transform(far).camera_state(far, 3)
    assert torch.allclose(torch.tensor(here.position), torch.tensor(there.position), atol=1e-6)


def test_the_page_looks_along_plus_z_with_y_down() -> None:
    one = pinhole(torch.eye(4, dtype=torch.float64)[None, :3], width=100, height=100, fov=90.0)
    transform = page_transform(one)._replace(scale=1.0)
    state = checked_camera((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), math.pi / 2, 100, 100)
    cameras = transform.cameras([state], (100, 100))
    pixel, depth = project(cameras, torch.zeros(1, dtype=torch.int64), torch.tensor([[0.5, 0.25, 1.0]], dtype=torch.float64))
    assert float(depth[0]) == pytest.approx(1.0) and pixel[0].tolist() == pytest.approx([75.0, 62.5])


@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.01),
    st.tuples(*[st.floats(-1e9, 1e9)] * 3),
    st.floats(-10, 10),
    st.integers(0, 20000),
    st.integers(0, 20000),
)
def test_whatever_numbers_come_the_camera_can_be_rendered(
    wxyz: tuple[float, ...], position: tuple[float, ...], fov: float, width: int, height: int
) -> None:
    camera = checked_camera(wxyz, position, fov, width, height)
    assert math.hypot(*camera.wxyz) == pytest.approx(1.0) and all(abs(x) <= 1e6 for x in camera.position)
    assert 0.02 <= camera.fov <= 3.0 and 0.1 <= camera.aspect <= 10


@pytest.mark.parametrize("numbers", ["nan 0 0 1 0 0 0 1", "1 0 0 0 inf 0 0 1", "1 0 0 0 0 0 0 nan", "0 0 0 0 0 0 0 1"])
def test_what_is_no_camera_is_refused(numbers: str) -> None:
    *pose, fov = map(float, numbers.split())
    with pytest.raises(UsageError, match="camera"):
        checked_camera(pose[:4], pose[4:], fov, 640, 480)
    with pytest.raises(UsageError, match="ten finite"):
        checked_camera((1, 0, 0), (0, 0, 0), 1.0, 640, 480)


@given(st.floats(0.1, 10), st.integers(1, 100_000))
def test_pictures_have_the_shape_asked_for_and_are_never_huge(aspect: float, longest: int) -> None:
    width, height = picture_size(aspect, longest)
    assert max(width, height) == max(8, min(longest, 4096)) and min(width, height) >= 1
    assert abs(width / aspect - height) <= 1 + 1 / aspect


def test_pyramids_and_paths_are_where_the_cameras_are(world: World) -> None:
    cameras = world.load().known.cameras
    transform = page_transform(cameras)
    lines = camera_frustums(transform, cameras, 0.1)
    assert lines.shape == (10 * len(cameras), 2, 3) and lines.dtype == np.float32
    for view in range(len(cameras)):
        own = lines[10 * view : 10 * view + 10]
        tip = transform.to_page(cameras.pose[view, :, 3]).numpy()
        assert np.allclose(own[:4, 0], tip, atol=1e-5)
        ahead = -cameras.pose[view, :, 2].numpy()
        assert np.allclose((own[:4, 1] - tip) @ ahead, 0.1, atol=1e-5)
        up = cameras.pose[view, :, 1].numpy()
        assert ((own[8, 1] - tip) @ up) > 0 and np.allclose(own[8, 1], own[9, 0])  # the roof
    path = path_segments(transform, cameras)
    assert path.shape == (len(cameras) - 1, 2, 3) and np.array_equal(path[:-1, 1], path[1:, 0])
    assert path_segments(transform, cameras.select(torch.tensor([0]))).shape == (0, 2, 3)


def test_boxes_have_twelve_edges_of_their_own_sides() -> None:
    ends = torch.tensor([[[0.0, 0, 0], [1, 2, 3]], [[1, 0, 0], [2, 2, 3]]], dtype=torch.float64)
    cells = [Cell(low=low, high=high, border=torch.full((3,), 0.1).double()) for low, high in ends]
    space = Space(kind="open", centre=(10.0, 20.0, 30.0), rotation=tuple(map(tuple, torch.eye(3).tolist())), scale=2.0,
                  near=0.1, far=10.0)  # fmt: skip
    transform = PageTransform(torch.tensor([10.0, 20.0, 30.0], dtype=torch.float64), 0.5, (0.0, 0.0, 1.0))
    lines = box_edges(transform, space, cells)
    assert lines.shape == (24, 2, 3)
    lengths = np.sort(np.linalg.norm(lines[:12, 1] - lines[:12, 0], axis=-1))
    assert np.allclose(lengths, np.repeat([0.25, 0.5, 0.75], 4), atol=1e-5)  # sides over 2 (space) times 0.5 (page)
    corners = lines.reshape(2, 24, 3)
    inside = (corners[0] * 4).T  # back to the space
    assert inside.min() == pytest.approx(0, abs=1e-5) and inside.max(1) == pytest.approx([1, 2, 3], abs=1e-4)
    shared = {tuple(np.round(p, 4)) for p in corners[0]} & {tuple(np.round(p, 4)) for p in corners[1]}
    assert len(shared) == 4  # neighbours share a face


@pytest.mark.parametrize(("aspect", "height"), [(0.5, 1.0), (2.0, 0.5), (0.25, 1.0)])
def test_a_page_wider_than_a_photograph_is_cut_above_as_much_as_it_shows_beside(aspect: float, height: float) -> None:
    photograph = CameraState((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), math.radians(90), 0.5)
    shown = photograph.for_aspect(aspect)
    assert math.tan(shown.fov / 2) == pytest.approx(height) and shown.aspect == aspect
