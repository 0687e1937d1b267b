"""Cameras behind rays: exact where there is one, told apart where there is none."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.datamanagers.parsers.blocknerf import fit_camera
from fprf.rendering.cameras import Cameras, pixel_grid, rays_through

number = st.floats(-1, 1)


def rays_of(camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    width, height = camera.size[0].tolist()
    origin, direction = rays_through(camera, torch.zeros(width * height, dtype=torch.int64), pixel_grid(camera, 0))
    return (x.float().numpy().reshape(height, width, 3) for x in (origin, direction))  # type: ignore[return-value]


def camera(turn: np.ndarray, k: tuple[float, ...] = (0.0,) * 6, focal: tuple[float, float] = (40.0, 42.0)) -> Cameras:
    pose = np.concatenate([turn, np.array([[100.0], [-20.0], [3.0]])], 1)
    return Cameras(
        pose=torch.from_numpy(pose)[None],
        focal=torch.tensor([focal], dtype=torch.float64),
        centre=torch.tensor([[31.0, 25.5]], dtype=torch.float64),
        size=torch.tensor([[64, 48]]),
        distortion=torch.tensor([k], dtype=torch.float64),
        lens=torch.tensor([1 if any(k) else 0]),
    )


def turned(x: float, y: float, z: float) -> np.ndarray:
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-9:
        return np.eye(3)
    a = np.array([x, y, z]) / length
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    angle = length * 3
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)


@settings(max_examples=25, deadline=None)
@given(number, number, number, number, number)
def test_a_bent_camera_is_found_again(x: float, y: float, z: float, k1: float, p1: float) -> None:
    truth = camera(turned(x, y, z), (0.1 * k1, -0.02 * k1, 0.0, 0.0, 0.002 * p1, 0.001))
    found = fit_camera(*rays_of(truth))
    assert found.error < 2e-3 and found.drift < 1e-4
    np.testing.assert_allclose(found.pose, truth.pose[0].numpy(), atol=3e-4)
    np.testing.assert_allclose(found.focal, (40.0, 42.0), rtol=3e-4)
    np.testing.assert_allclose(found.centre, (31.0, 25.5), atol=2e-2)
    np.testing.assert_allclose(found.distortion, truth.distortion[0].numpy(), atol=2e-3)


def test_directions_need_not_be_unit() -> None:
    origin, direction = rays_of(camera(np.eye(3)))
    found = fit_camera(origin, direction * np.float32(3.5))
    np.testing.assert_allclose(found.focal, (40.0, 42.0), rtol=1e-4)


def test_a_rolling_shutter_is_told_by_its_drift() -> None:
    origin, direction = rays_of(camera(np.eye(3)))
    moved = origin + np.linspace(-0.1, 0.1, 48, dtype=np.float32)[:, None, None] * np.array([1, 0, 0], np.float32)
    found = fit_camera(moved, direction)
    assert found.drift == pytest.approx(0.1, rel=1e-3) and found.error < 1e-3


def test_rays_of_no_camera_have_a_large_error_or_are_refused() -> None:
    origin, direction = rays_of(camera(np.eye(3)))
    noisy = direction + np.random.default_rng(0).normal(0, 0.1, direction.shape).astype(np.float32)
    assert fit_camera(origin, noisy).error > 1.5
    for wrong in (np.zeros_like(direction), direction[:, ::-1], np.random.default_rng(0).normal(size=direction.shape)):
        with pytest.raises(ValueError, match="rays"):
            fit_camera(origin, wrong.astype(np.float32))
    with pytest.raises(ValueError, match="too few"):
        fit_camera(origin[:2, :2], direction[:2, :2])
