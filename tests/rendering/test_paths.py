import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import UsageError
from fprf.rendering.cameras import Cameras, project
from fprf.rendering.paths import interpolate, look_at, orbit, spiral, tour

UP = torch.tensor([0.0, 0, 1], dtype=torch.float64)


def looking(position: torch.Tensor, target: torch.Tensor, up: torch.Tensor = UP) -> Cameras:
    count = len(position)
    return Cameras(
        pose=look_at(position, target.expand_as(position), up),
        focal=torch.full((count, 2), 90.0, dtype=torch.float64),
        centre=torch.tensor([[50.0, 40.0]], dtype=torch.float64).repeat(count, 1),
        size=torch.tensor([[100, 80]]).repeat(count, 1),
        distortion=torch.full((count, 6), 0.01, dtype=torch.float64),
        lens=torch.ones(count, dtype=torch.int64),
    )


def random(count: int, seed: int) -> torch.Tensor:
    return torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def forward_facing(seed: int = 0, count: int = 24) -> Cameras:
    """Before a wall at y = 10, as LLFF captures are."""
    position = random(count, seed) * torch.tensor([1.0, 0.1, 0.6], dtype=torch.float64)
    return looking(position, position + torch.tensor([0.0, 10, 0]) + 0.3 * random(count, seed + 1))


def surrounding(seed: int = 0, count: int = 60) -> Cameras:
    """On the upper part of a sphere of radius 4 about (3, 2, 1)."""
    target = torch.tensor([3.0, 2, 1], dtype=torch.float64)
    offset = torch.nn.functional.normalize(random(count, seed), dim=-1) * torch.tensor([1.0, 1, 0.4])
    offset[:, 2] = offset[:, 2].abs() + 0.3
    return looking(target + 4 * torch.nn.functional.normalize(offset, dim=-1), target)


def street(seed: int = 0, count: int = 30) -> Cameras:
    """Along a line, looking ahead."""
    position = torch.stack([torch.arange(count), torch.zeros(count), torch.zeros(count)], -1) + 0.05 * random(count, seed)
    return looking(position, position + torch.tensor([10.0, 0, 0]) + 0.2 * random(count, seed + 1))


def survey(seed: int = 0) -> Cameras:
    """A lawn-mower flight straight down: headings alternate."""
    y, x = torch.meshgrid(torch.arange(5.0), torch.arange(8.0), indexing="ij")
    position = torch.stack([x, y, torch.full_like(x, 6)], -1).reshape(-1, 3).double() + 0.05 * random(40, seed)
    cameras = looking(position, position - UP, torch.tensor([0.0, 1, 0], dtype=torch.float64))
    flipped = cameras.pose.clone()
    flipped[8:16, :, :2] *= -1
    flipped[24:32, :, :2] *= -1
    return Cameras(flipped, cameras.focal, cameras.centre, cameras.size, cameras.distortion, cameras.lens)


CAPTURES = [forward_facing, surrounding, street, survey]


def assert_rigid(path: Cameras, bound: float = 1e-12) -> None:
    rotation = path.pose[:, :, :3]
    assert bool(torch.isfinite(path.pose).all()) and path.pose.dtype == torch.float64
    assert float((rotation.mT @ rotation - torch.eye(3)).abs().max()) < bound
    assert float((torch.linalg.det(rotation) - 1).abs().max()) < bound


def steps(path: Cameras) -> torch.Tensor:
    """Distances between neighbouring frames, the last one to the first."""
    position = path.pose[:, :, 3]
    return (position - position.roll(-1, 0)).norm(dim=-1)


def turns(path: Cameras) -> torch.Tensor:
    """Angles between neighbouring frames."""
    rotation = path.pose[:, :, :3]
    trace = (rotation.mT @ rotation.roll(-1, 0)).diagonal(dim1=1, dim2=2).sum(-1)
    return torch.acos(((trace - 1) / 2).clamp(-1, 1))


def strayed(path: Cameras, cameras: Cameras) -> float:
    return float(torch.cdist(path.pose[:, :, 3], cameras.pose[:, :, 3]).amin(-1).max())


def spacing(cameras: Cameras) -> float:
    apart = torch.cdist(cameras.pose[:, :, 3], cameras.pose[:, :, 3]).fill_diagonal_(math.inf)
    return float(apart.amin(-1).max())


@pytest.mark.parametrize("capture", CAPTURES)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1000))
def test_a_spiral_stays_with_the_cameras_closed_and_smooth(capture: Callable[[int], Cameras], seed: int) -> None:
    cameras = capture(seed)
    path = spiral(cameras, 90)
    assert len(path) == 90
    assert_rigid(path)
    assert strayed(path, cameras) <= spacing(cameras)
    length = float(steps(path).sum())
    assert length > 0.1 * spacing(cameras)
    assert float(steps(path).max()) < 5 * length / 90
    assert float(turns(path).max()) < 0.1
    assert bool((path.distortion == 0).all()) and bool((path.lens == 0).all())


@pytest.mark.parametrize("capture", CAPTURES)
def test_a_spiral_looks_at_what_the_central_camera_sees(capture: Callable[[int], Cameras]) -> None:
    cameras = capture(1)
    centres = cameras.pose[:, :, 3]
    middle = int(torch.cdist(centres, centres).sum(-1).argmin())
    target = centres[middle] - 7 * cameras.pose[middle, :, 2]
    path = spiral(cameras, 40, points=target + 0.01 * random(50, 2))
    pixel, depth = project(path, torch.arange(40), target.expand(40, 3))
    assert float((pixel - path.centre).abs().max()) < 0.5
    assert bool((depth > 0).all())


def test_one_camera_stands_still_and_points_behind_are_ignored() -> None:
    cameras = looking(torch.zeros(1, 3, dtype=torch.float64), torch.tensor([0.0, 5, 0], dtype=torch.float64))
    path = spiral(cameras, 5, points=torch.tensor([[0.0, -5, 0]]).repeat(20, 1).double())
    torch.testing.assert_close(path.pose, cameras.pose.repeat(5, 1, 1), atol=1e-12, rtol=0)
    assert_rigid(orbit(cameras, 5))


@pytest.mark.parametrize("capture", CAPTURES)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1000))
def test_an_orbit_is_rigid_closed_and_smooth(capture: Callable[[int], Cameras], seed: int) -> None:
    path = orbit(capture(seed), 120)
    assert_rigid(path)
    # Its last frame leads to the first as any other does to the next.
    assert float(steps(path).max()) <= 6 * float(steps(path).mean()) + 1e-9
    assert float(turns(path).max()) < 0.25


@pytest.mark.parametrize("seed", [63, 149, 160, 316, 593, 835])
def test_cameras_that_look_one_way_do_not_circle_among_themselves(seed: int) -> None:
    """Their axes come closest to each other where the cameras are."""
    path = orbit(forward_facing(seed), 120)
    assert float(turns(path).max()) < 0.25 and float(steps(path).max()) <= 6 * float(steps(path).mean())


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_an_orbit_of_a_surrounded_place_is_a_full_circle_at_its_distance(seed: int) -> None:
    cameras = surrounding(seed)
    path = orbit(cameras, 60)
    target = torch.tensor([3.0, 2, 1], dtype=torch.float64)
    offset = path.pose[:, :, 3] - target
    assert float((offset.norm(dim=-1) - 4).abs().max()) < 1e-6
    assert bool((offset[:, 2] > 0.2).all())
    pixel, _ = project(path, torch.arange(60), target.expand(60, 3))
    assert float((pixel - path.centre).abs().max()) < 1e-6
    azimuth = torch.atan2(offset[:, 1], offset[:, 0]).sort().values
    assert float((azimuth[1:] - azimuth[:-1]).max()) < 2 * math.pi / 60 * 1.6


def test_an_orbit_of_an_arc_turns_back_at_its_ends() -> None:
    angle = torch.linspace(0.0, 1.0, 12, dtype=torch.float64)
    position = 4 * torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.2)], -1)
    path = orbit(looking(position, torch.zeros(3, dtype=torch.float64)), 50)
    azimuth = torch.atan2(path.pose[:, 1, 3], path.pose[:, 0, 3])
    assert float(azimuth.min()) > -0.05 and float(azimuth.max()) < 1.05
    assert float(azimuth.max() - azimuth.min()) > 0.9


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 7), st.integers(0, 5), st.integers(0, 1000))
def test_interpolation_passes_through_its_views(views: int, between: int, seed: int) -> None:
    cameras = looking(random(9, seed), 5 * random(9, seed + 1))
    order = torch.randperm(9, generator=torch.Generator().manual_seed(seed))[:views]
    path = interpolate(cameras, order, between)
    assert len(path) == (views - 1) * (between + 1) + 1
    assert_rigid(path)
    torch.testing.assert_close(path.pose[:: between + 1], cameras.pose[order], atol=1e-11, rtol=0)
    assert bool((path.lens == 0).all()) and path.size.tolist() == [[100, 80]] * len(path)


def test_interpolation_is_smooth_where_views_are_uneven_and_where_they_coincide() -> None:
    x = torch.tensor([0.0, 0, 0.1, 5, 5.2, 5.2, 9], dtype=torch.float64)
    position = torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], -1)
    cameras = looking(position, position + torch.tensor([0.0, 1, 0]))
    path = interpolate(cameras, torch.arange(7), 49)
    assert_rigid(path)
    along = path.pose[:, 0, 3]
    assert float(along.diff().min()) > -1e-12
    # The longest gap, 4.9 in 50 frames, from nearly rest to nearly rest: its acceleration is 6 * 4.9 / 50^2.
    assert float(along.diff(n=2).abs().max()) < 0.013


def test_interpolated_intrinsics_move_evenly_at_the_first_size() -> None:
    cameras = looking(random(2, 0), 5 * random(2, 1))
    cameras = Cameras(
        cameras.pose, torch.tensor([[90.0, 80.0], [200.0, 240.0]]).double(), torch.tensor([[50.0, 40], [100, 80]]).double(),
        torch.tensor([[100, 80], [200, 160]]), cameras.distortion, cameras.lens)  # fmt: skip
    path = interpolate(cameras, torch.tensor([0, 1]), 1)
    assert path.focal.tolist() == [[90, 80], [95, 100], [100, 120]]
    assert path.centre.tolist() == [[50, 40]] * 3 and path.size.tolist() == [[100, 80]] * 3


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_a_tour_visits_every_view_once_along_a_line(seed: int) -> None:
    cameras = street(seed)
    shuffled = torch.randperm(30, generator=torch.Generator().manual_seed(seed))
    found = tour(cameras, shuffled).tolist()
    assert sorted(found) == list(range(30))
    assert found in (list(range(30)), list(range(29, -1, -1)))
    assert tour(cameras, shuffled[:0]).tolist() == []


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_look_at_is_level_and_survives_looking_along_up(seed: int) -> None:
    position, target = random(6, seed), random(6, seed + 7)
    target[0] = position[0] + UP
    target[1] = position[1] - 1e-13 * UP
    pose = look_at(position, target, UP)
    assert float((pose[:, :, :3].mT @ pose[:, :, :3] - torch.eye(3)).abs().max()) < 1e-12
    assert float(pose[2:, 2, 0].abs().max()) < 1e-12 and bool((pose[2:, 2, 1] >= 0).all())


def test_wrong_requests() -> None:
    cameras = forward_facing()
    for wrong in (
        lambda: spiral(cameras, 0),
        lambda: spiral(cameras, 5, turns=0),
        lambda: orbit(cameras, 0),
        lambda: interpolate(cameras, torch.tensor([0, 1]), -1),
        lambda: interpolate(cameras, torch.tensor([], dtype=torch.int64), 3),
    ):
        with pytest.raises(UsageError, match="must be at least"):
            wrong()
