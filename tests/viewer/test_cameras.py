import math
from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_world import World

from fprf.errors import UsageError
from fprf.rendering.cameras import Cameras, project
from fprf.viewer.cameras import Eye, checked_eye, fitted, stage_of


def test_a_captured_camera_goes_to_the_page_and_back(world: World) -> None:
    cameras = world.load().known.cameras
    stage = stage_of(cameras)
    for view in range(len(cameras)):
        width, height = (int(v) for v in cameras.size[view])
        back = stage.cameras([stage.eye(cameras, view)], (width, height))
        assert torch.allclose(back.pose[0], cameras.pose[view], atol=1e-9)
        assert torch.allclose(back.focal[0], cameras.focal[view, 1].repeat(2), atol=1e-9)


def test_far_from_the_origin_nothing_is_lost(world: World) -> None:
    cameras = world.load().known.cameras
    shift = torch.tensor([4.5e6, -3.0e5, 120.0], dtype=torch.float64)
    far = replace(cameras, pose=torch.cat([cameras.pose[:, :, :3], cameras.pose[:, :, 3:] + shift[:, None]], -1))
    here, there = stage_of(cameras).eye(cameras, 3), stage_of(far).eye(far, 3)
    assert torch.allclose(torch.tensor(here.position), torch.tensor(there.position), atol=1e-6)


def test_most_cameras_lie_within_two_units_and_up_is_theirs(world: World) -> None:
    cameras = world.load().known.cameras
    stage = stage_of(cameras)
    places = stage.to_page(cameras.pose[:, :, 3])
    assert 0.85 <= float((places.norm(dim=-1) <= 2.001).double().mean()) <= 1.0
    assert math.isclose(math.hypot(*stage.up), 1.0, rel_tol=1e-9)
    assert float((cameras.pose[:, :, 1] @ torch.tensor(stage.up, dtype=torch.float64)).mean()) > 0.5


def test_one_camera_alone_has_a_stage(world: World) -> None:
    one = world.load().known.cameras.select(torch.tensor([0]))
    stage = stage_of(one)
    assert stage.scale == 1.0 and stage.eye(one, 0).position == (0.0, 0.0, 0.0)


def test_the_page_looks_along_plus_z_with_y_down() -> None:
    one = Cameras(
        pose=torch.eye(4, dtype=torch.float64)[None, :3],
        focal=torch.full((1, 2), 50.0, dtype=torch.float64),
        centre=torch.full((1, 2), 50.0, dtype=torch.float64),
        size=torch.tensor([[100, 100]]),
        distortion=torch.zeros(1, 6, dtype=torch.float64),
        lens=torch.zeros(1, dtype=torch.int64),
    )
    stage = stage_of(one)._replace(scale=1.0)
    eye = checked_eye((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), math.pi / 2, 100, 100)
    cameras = stage.cameras([eye], (100, 100))
    pixel, depth = project(cameras, torch.zeros(1, dtype=torch.int64), torch.tensor([[0.5, 0.25, 1.0]], dtype=torch.float64))
    assert float(depth[0]) == pytest.approx(1.0) and pixel[0].tolist() == pytest.approx([75.0, 62.5])


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=60)
@given(
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.01),
    st.tuples(*[st.floats(-1e9, 1e9)] * 3),
    st.floats(-10, 10),
    st.integers(0, 20000),
    st.integers(0, 20000),
)
def test_whatever_numbers_come_the_eye_is_one_that_can_be_rendered(
    wxyz: tuple[float, ...], position: tuple[float, ...], fov: float, width: int, height: int
) -> None:
    eye = checked_eye(wxyz, position, fov, width, height)
    assert math.hypot(*eye.wxyz) == pytest.approx(1.0) and all(abs(x) <= 1e6 for x in eye.position)
    assert 0.02 <= eye.fov <= 3.0 and 0.1 <= eye.aspect <= 10


@pytest.mark.parametrize(
    "numbers",
    [
        ((math.nan, 0, 0, 1), (0, 0, 0), 1.0),
        ((1, 0, 0, 0), (math.inf, 0, 0), 1.0),
        ((1, 0, 0, 0), (0, 0, 0), math.nan),
        ((0, 0, 0, 0), (0, 0, 0), 1.0),
        ((1, 0, 0), (0, 0, 0), 1.0),
    ],
)
def test_what_is_no_camera_is_refused(numbers: tuple[tuple[float, ...], tuple[float, ...], float]) -> None:
    with pytest.raises(UsageError, match="camera"):
        checked_eye(*numbers, 640, 480)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.floats(0.1, 10), st.integers(1, 100_000))
def test_pictures_have_the_shape_asked_for_and_are_never_huge(aspect: float, longest: int) -> None:
    width, height = fitted(aspect, longest)
    assert max(width, height) == max(8, min(longest, 4096)) and min(width, height) >= 1
    assert abs(width / aspect - height) <= 1 + 1 / aspect


def test_equal_eyes_are_equal() -> None:
    assert Eye((1, 0, 0, 0), (0, 0, 0), 1.0, 1.5) == Eye((1, 0, 0, 0), (0, 0, 0), 1.0, 1.5)
