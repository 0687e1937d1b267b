"""Captures far from 0 in every format: one scene about a local origin, exact in the world."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import Capture
from moved_scene import UTM
from test_parsers import FORMATS

from fprf.datamanagers.bounds import find_space
from fprf.datamanagers.parsers.config import parse_scene
from fprf.datamanagers.scene import at_origin

ECEF = (4_000_000.0, 1_000_000.0, 4_900_000.0)


@pytest.mark.parametrize("shift", [UTM, ECEF])
@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_read_in_float64(tmp_path: Path, name: str, shift: tuple[float, float, float]) -> None:
    own = Capture.make(9, focal=(20.0, 20.0))
    poses = own.poses.copy()
    poses[:, :, 3] += shift
    FORMATS[name][1](tmp_path, replace(own, poses=poses, points=own.points + shift))
    scene = parse_scene(tmp_path, 1, FORMATS[name][0])
    origin = np.array(scene.origin)
    assert np.abs(origin - shift).max() < 8 and float(scene.cameras.pose[:, :, 3].abs().max()) < 8
    assert np.abs(scene.cameras.pose.numpy()[:, :, :3] - own.poses[:, :, :3]).max() < 1e-9
    # float64 has a nanometre there; ODM's rotation vectors, by which a world-to-camera pose is inverted, keep less.
    assert np.abs(scene.cameras.pose.numpy()[:, :, 3] + (origin - shift) - own.poses[:, :, 3]).max() < 1e-7
    if scene.points is not None:
        assert np.abs(scene.points.numpy() + (origin - shift) - own.points).max() < 1e-8


def test_a_scene_can_be_put_about_another_origin_and_back(tmp_path: Path) -> None:
    own = Capture.make(9)
    FORMATS["transforms"][1](tmp_path, own)
    scene = parse_scene(tmp_path, 1, None)
    assert scene.origin == (0, 0, 0) and np.array_equal(scene.cameras.pose.numpy()[:, :, 3], own.poses[:, :, 3])
    moved = at_origin(scene, (-8.0, 16.0, 0.0))
    assert moved.origin == (-8, 16, 0) and torch.equal(moved.cameras.pose[:, :, :3], scene.cameras.pose[:, :, :3])
    away = torch.tensor([8.0, -16.0, 0.0], dtype=torch.float64)
    assert torch.allclose(moved.cameras.pose[:, :, 3], scene.cameras.pose[:, :, 3] + away, atol=1e-12, rtol=0)
    assert scene.points is not None and moved.points is not None
    assert torch.allclose(moved.points, scene.points + away, atol=1e-12, rtol=0)
    back = at_origin(moved, (0.0, 0.0, 0.0))
    assert torch.allclose(back.cameras.pose, scene.cameras.pose, atol=1e-12, rtol=0)
    a, b = find_space(scene), find_space(moved)
    assert torch.allclose(torch.tensor(b.centre), torch.tensor(a.centre) + away.float(), atol=1e-5) and a.kind == b.kind
