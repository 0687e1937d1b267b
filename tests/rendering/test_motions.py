import math
from pathlib import Path

import pytest
import torch

from fprf.errors import DataError, UsageError
from fprf.rendering.camera_path import write_camera_path
from fprf.rendering.cameras import Cameras, project
from fprf.rendering.paths import look_at, make_path, pinhole, upwards


def around(count: int = 12) -> Cameras:
    """On a circle of radius 5 about the origin, 2 above it."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    position = torch.stack([5 * angle.cos(), 5 * angle.sin(), torch.full_like(angle, 2.0)], -1)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    return pinhole(look_at(position, torch.zeros_like(position), up), width=64, height=48, fov=50)


@pytest.mark.parametrize("frames", [1, 2, 11, 100])
def test_an_interpolation_has_about_the_frames_asked_for(frames: int) -> None:
    made = len(make_path(around(), range(12), "interpolate", frames))
    assert made == max(12, made) and abs(made - frames) <= max(11, 12 - frames)


def test_a_file_is_a_path_too(tmp_path: Path) -> None:
    frames = around(3)
    write_camera_path(tmp_path / "path.json", frames, 24)
    read = make_path(around(), [], str(tmp_path / "path.json"), 99)
    assert len(read) == 3 and torch.allclose(read.pose, frames.pose, atol=1e-9)
    (tmp_path / "other.json").write_text("[]")
    with pytest.raises(DataError, match=r"other\.json"):
        make_path(around(), [], str(tmp_path / "other.json"), 99)
    with pytest.raises(UsageError, match="--path spirale: neither a file nor one of spiral, orbit"):
        make_path(around(), [], "spirale", 3)


def test_up_is_the_cameras_own_or_against_their_view() -> None:
    up = upwards(around())
    assert torch.allclose(up / up.norm(), torch.tensor([0.0, 0, 1], dtype=torch.float64), atol=1e-9)
    angle = torch.arange(8, dtype=torch.float64)
    position = torch.stack([angle, angle.square(), torch.full_like(angle, 30.0)], -1)
    heading = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    below = position - torch.tensor([0.0, 0, 30], dtype=torch.float64)
    poses = torch.cat([look_at(position[k : k + 1], below[k : k + 1], heading[k]) for k in range(8)])
    up = upwards(pinhole(poses, width=8, height=8, fov=60))
    assert torch.allclose(up / up.norm(), torch.tensor([0.0, 0, 1], dtype=torch.float64), atol=1e-6)


@pytest.mark.parametrize("fov", [20.0, 90.0, 150.0])
def test_a_pinhole_sees_its_angle(fov: float) -> None:
    pose = look_at(
        *(torch.tensor([p], dtype=torch.float64) for p in ((0.0, 0, 0), (1.0, 0, 0))), torch.tensor([0.0, 0, 1]).double()
    )
    camera = pinhole(pose, width=30, height=20, fov=fov)
    edge = torch.tensor([[1.0, 0, math.tan(math.radians(fov) / 2)]], dtype=torch.float64)
    pixel, depth = project(camera, torch.tensor([0]), edge)
    assert torch.allclose(pixel, torch.tensor([[15.0, 0.0]], dtype=torch.float64), atol=1e-9) and float(depth) == pytest.approx(
        1
    )
