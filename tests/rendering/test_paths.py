"""Camera paths: rigid, smooth, near the capture, there and back in files; the splines that they follow."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError, UsageError
from fprf.rendering.cameras import Cameras, ideal_cameras, project
from fprf.rendering.lens import OPENCV
from fprf.rendering.paths import (
    interpolate,
    look_at,
    make_path,
    orbit,
    pinhole,
    read_camera_path,
    spiral,
    upwards,
    write_camera_path,
)
from fprf.rendering.splines import catmull_rom, quaternions, rotations, slerp

UP = torch.tensor([0.0, 0, 1], dtype=torch.float64)


def looking(position: torch.Tensor, target: torch.Tensor) -> Cameras:
    views = ideal_cameras(look_at(position, target.expand_as(position), UP), 90.0, (100, 80))
    return replace(views, distortion=views.distortion + 0.01, lens=torch.full_like(views.lens, OPENCV))


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
    position = torch.stack([torch.arange(count), torch.zeros(count), torch.zeros(count)], -1) + 0.05 * random(
        count, seed
    )
    return looking(position, position + torch.tensor([10.0, 0, 0]) + 0.2 * random(count, seed + 1))


CAPTURES = [forward_facing, surrounding, street]


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
@settings(max_examples=8)
@given(seed=st.integers(0, 1000))
def test_a_spiral_stays_with_the_cameras_closed_and_smooth(
    capture: Callable[[int], Cameras], seed: int
) -> None:
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


def test_a_spiral_looks_at_what_the_central_camera_sees() -> None:
    path = spiral(surrounding(1), 40)
    pixel, depth = project(path, torch.arange(40), torch.tensor([[3.0, 2, 1]]).expand(40, 3))
    assert float((pixel - path.centre).abs().max()) < 0.5 and bool((depth > 0).all())


@pytest.mark.parametrize("capture", CAPTURES)
@settings(max_examples=8)
@given(seed=st.integers(0, 1000))
def test_an_orbit_is_rigid_closed_and_smooth(capture: Callable[[int], Cameras], seed: int) -> None:
    path = orbit(capture(seed), 120)
    assert_rigid(path)
    # Its last frame leads to the first as any other does to the next.
    assert float(steps(path).max()) <= 6 * float(steps(path).mean()) + 1e-9
    assert float(turns(path).max()) < 0.25


@settings(max_examples=10)
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


@given(st.integers(1, 7), st.integers(0, 5), st.integers(0, 1000))
def test_interpolation_passes_through_its_views(views: int, between: int, seed: int) -> None:
    cameras = looking(random(9, seed), 5 * random(9, seed + 1))
    order = torch.randperm(9, generator=torch.Generator().manual_seed(seed))[:views]
    path = interpolate(cameras, order, between)
    assert len(path) == (views - 1) * (between + 1) + 1
    assert_rigid(path)
    torch.testing.assert_close(path.pose[:: between + 1], cameras.pose[order], atol=1e-11, rtol=0)
    assert bool((path.lens == 0).all()) and path.size.tolist() == [[100, 80]] * len(path)


@pytest.mark.parametrize("frames", [1, 2, 7, 12, 99])
def test_an_interpolation_has_about_the_frames_asked_for(frames: int) -> None:
    made = len(make_path(around(12), range(12), "interpolate", frames))
    assert made == (frames if frames <= 12 else 100)


@given(st.integers(0, 1000))
def test_look_at_is_level_and_survives_looking_along_up(seed: int) -> None:
    position = random(6, seed)
    target = random(6, seed + 7)
    target[0] = position[0] + UP
    target[1] = position[1] - 1e-13 * UP
    pose = look_at(position, target, UP)
    assert float((pose[:, :, :3].mT @ pose[:, :, :3] - torch.eye(3)).abs().max()) < 1e-12
    assert float(pose[2:, 2, 0].abs().max()) < 1e-12 and bool((pose[2:, 2, 1] >= 0).all())


def around(count: int = 12) -> Cameras:
    """On a circle of radius 5 about the origin, 2 above it."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    position = torch.stack([5 * angle.cos(), 5 * angle.sin(), torch.full_like(angle, 2.0)], -1)
    return pinhole(look_at(position, torch.zeros_like(position), UP), width=64, height=48, fov=50)


def test_a_file_is_a_path_too(tmp_path: Path) -> None:
    frames = around(3)
    write_camera_path(tmp_path / "path.json", frames, 24)
    read = make_path(around(), [], str(tmp_path / "path.json"), 99)
    assert len(read) == 3 and torch.allclose(read.pose, frames.pose, atol=1e-9)
    for text in ("[]", "{"):
        (tmp_path / "other.json").write_text(text)
        with pytest.raises(DataError, match=r"other\.json"):
            make_path(around(), [], str(tmp_path / "other.json"), 99)
    with pytest.raises(UsageError, match="--path spirale: neither a file nor one of spiral, orbit"):
        make_path(around(), [], "spirale", 3)


def test_up_is_the_cameras_own_or_against_their_view() -> None:
    up = upwards(around())
    assert torch.allclose(up / up.norm(), UP, atol=1e-9)
    angle = torch.arange(8, dtype=torch.float64)
    position = torch.stack([angle, angle.square(), torch.full_like(angle, 30.0)], -1)
    heading = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    poses = torch.cat(
        [
            look_at(place[None], place[None] - 30 * UP, way)
            for place, way in zip(position, heading, strict=True)
        ]
    )
    up = upwards(pinhole(poses, width=8, height=8, fov=60))
    assert torch.allclose(up / up.norm(), UP, atol=1e-6)


def turn(axis: torch.Tensor, angle: float) -> torch.Tensor:
    """Rodrigues' formula."""
    x, y, z = torch.nn.functional.normalize(axis, dim=-1).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return (
        torch.eye(3, dtype=torch.float64)
        + math.sin(angle) * cross
        + 2 * math.sin(angle / 2) ** 2 * cross @ cross
    )


def axis(seed: int) -> torch.Tensor:
    return torch.randn(3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@given(
    st.integers(0, 10_000),
    st.floats(-math.pi, math.pi) | st.sampled_from([0.0, 1e-9, math.pi, math.pi - 1e-9]),
)
def test_quaternions_round_trip(seed: int, angle: float) -> None:
    rotation = turn(axis(seed), angle)[None]
    quaternion = quaternions(rotation)
    assert abs(float(quaternion.norm()) - 1) < 1e-14
    torch.testing.assert_close(rotations(quaternion), rotation, atol=1e-13, rtol=0)
    torch.testing.assert_close(rotations(-3 * quaternion), rotation, atol=1e-13, rtol=0)


@given(
    st.integers(0, 10_000), st.floats(1e-12, math.pi - 1e-6) | st.just(0.0), st.floats(0, 1), st.booleans()
)
def test_slerp_is_the_part_of_the_turn(seed: int, angle: float, u: float, flip: bool) -> None:
    start = turn(axis(seed + 1), 1.3)
    ends = quaternions(torch.stack([start, start @ turn(axis(seed), angle)]))
    found = slerp(ends[:1], -ends[1:] if flip else ends[1:], torch.tensor([u], dtype=torch.float64))
    assert abs(float(found.norm()) - 1) < 1e-12
    torch.testing.assert_close(rotations(found)[0], start @ turn(axis(seed), u * angle), atol=1e-9, rtol=0)


@given(st.integers(2, 6), st.integers(0, 1000))
def test_catmull_rom_passes_through_keys_with_one_velocity(count: int, seed: int) -> None:
    keys = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    gaps = torch.arange(count - 1)
    torch.testing.assert_close(catmull_rom(keys, gaps, torch.zeros(count - 1).double()), keys[:-1])
    ends = torch.full((count - 1,), 1 - 1e-12, dtype=torch.float64)
    torch.testing.assert_close(catmull_rom(keys, gaps, ends), keys[1:], atol=1e-10, rtol=0)
    step = 1e-6
    before = keys[1:-1] - catmull_rom(
        keys, gaps[:-1], torch.full((count - 2,), 1 - step, dtype=torch.float64)
    )
    after = catmull_rom(keys, gaps[1:], torch.full((count - 2,), step, dtype=torch.float64)) - keys[1:-1]
    torch.testing.assert_close(before / step, after / step, atol=1e-4, rtol=0)


@given(st.lists(st.floats(0, 10) | st.just(0.0), min_size=2, max_size=6))
def test_catmull_rom_never_turns_back_on_a_line(distances: list[float]) -> None:
    along = torch.tensor([0.0, *distances], dtype=torch.float64).cumsum(0)
    keys = along[:, None] * torch.tensor([1.0, -1, 2], dtype=torch.float64)
    u = torch.linspace(0, 1, 40, dtype=torch.float64).repeat(len(distances))
    gaps = torch.arange(len(distances)).repeat_interleave(40)
    assert float(catmull_rom(keys, gaps, u)[:, 0].diff().min()) > -1e-12


IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def file(path: Path, **changes: Any) -> Path:
    frame = {"camera_to_world": IDENTITY, "fov": 90.0, "aspect": 1.5}
    content = {"render_width": 300, "render_height": 200, "camera_path": [frame], **changes}
    path.write_text(json.dumps(content))
    return path


@settings(max_examples=15)
@given(st.integers(1, 6), st.floats(20, 4000), st.floats(1, 120), st.integers(0, 99))
def test_what_is_written_reads_back(
    tmp_path_factory: pytest.TempPathFactory, count: int, focal: float, fps: float, seed: int
) -> None:
    draw = torch.Generator().manual_seed(seed)
    position = torch.randn(count, 3, dtype=torch.float64, generator=draw)
    pose = look_at(
        position,
        position + torch.randn(count, 3, dtype=torch.float64, generator=draw),
        torch.eye(3).double()[2],
    )
    cameras = pinhole(pose, width=320, height=240, fov=math.degrees(2 * math.atan(120 / focal)))
    path = tmp_path_factory.getbasetemp() / "path.json"
    write_camera_path(path, cameras, fps)
    found, rate = read_camera_path(path)
    assert rate == fps
    torch.testing.assert_close(found.pose, cameras.pose, atol=1e-12, rtol=0)
    torch.testing.assert_close(found.focal, cameras.focal, atol=0, rtol=1e-9)
    assert torch.equal(found.centre, cameras.centre) and torch.equal(found.size, cameras.size)


def test_a_file_as_the_viewer_exports_it(tmp_path: Path) -> None:
    cameras, fps = read_camera_path(
        file(tmp_path / "p.json", camera_type="perspective", seconds=4, keyframes=[{}])
    )
    assert fps == 24 and cameras.focal.tolist() == [[pytest.approx(100.0)] * 2]
    assert cameras.centre.tolist() == [[150, 100]] and cameras.size.tolist() == [[300, 200]]


def test_a_rounded_rotation_is_made_exact(tmp_path: Path) -> None:
    turned = [0.70711, -0.70711, 0, 1, 0.70711, 0.70711, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]
    cameras, _ = read_camera_path(
        file(tmp_path / "p.json", camera_path=[{"camera_to_world": turned, "fov": 60}])
    )
    rotation = cameras.pose[0, :, :3]
    assert float((rotation.T @ rotation - torch.eye(3)).abs().max()) < 1e-14
    assert cameras.pose[0, :, 3].tolist() == [1, 2, 3]


FRAME = {"camera_to_world": IDENTITY, "fov": 60}


WRONG = [
    ("camera_type", "equirectangular"),
    ("render_width", 0),
    ("render_width", 10**400),
    ("fps", 0),
    ("camera_path", []),
]
WRONG_FRAMES = [{"fov": 60}, {**FRAME, "fov": 180}]
# letters, what is too large, a scale, a mirroring
WRONG_FRAMES += [{**FRAME, "camera_to_world": [first, *IDENTITY[1:]]} for first in ("x", 10**400, 2, -1)]


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [(name, value, name) for name, value in WRONG]
    + [("camera_path", [FRAME, frame], r"camera_path\[1\]") for frame in WRONG_FRAMES]
    + [("render_height", value, "cannot be read") for value in (math.inf, math.nan)],
)
def test_what_is_wrong_is_named(tmp_path: Path, name: str, value: object, told: str) -> None:
    with pytest.raises(DataError, match=told):
        read_camera_path(file(tmp_path / "p.json", **{name: value}))
