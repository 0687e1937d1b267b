"""Radial distortion of captures that come without a lens, from features matched between posed views."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from fprf.datamanagers.scene import ParsedScene
from fprf.rendering.cameras import Cameras, ideal_cameras, project
from fprf.splats import lens_estimate
from fprf.splats.config import GaussiansConfig
from fprf.splats.lens_estimate import Matches, best_k1, distances, estimate_k1, with_k1

CORNER = 0.7
"""Tangent of the widest angle of views of 640 x 480 with a focal length of 570."""


def views(count: int = 6) -> Cameras:
    """Cameras that stand around and look at the same things, each turned a little."""
    draw = torch.Generator().manual_seed(0)
    pose = torch.zeros(count, 3, 4, dtype=torch.float64)
    for view in range(count):
        turn = 0.05 * torch.randn(3, generator=draw).double()
        x, y, z = turn.tolist()
        pose[view, :, :3] = torch.linalg.matrix_exp(
            torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        )
        pose[view, :, 3] = 0.4 * torch.randn(3, generator=draw).double()
    return ideal_cameras(pose, 570.0, (640, 480))


def matches(k1: float, noise: float = 0.4, wrong: float = 0.1) -> list[Matches]:
    """What views with a lens see of random points, in pixels off by `noise`, a share of them of something else."""
    cameras = views()
    shown = with_k1(cameras, k1)
    draw = np.random.default_rng(1)
    found = []
    for a in range(len(cameras) - 1):
        points = torch.from_numpy(draw.uniform([-4, -3, -9], [4, 3, -3], (1200, 3)))
        tangents = []
        seen = np.ones(1200, bool)
        for view in (a, a + 1):
            pixel = project(shown, torch.full((1200,), view), points)[0].numpy()
            seen &= ((pixel > 0) & (pixel < [640, 480])).all(1)
            pixel = pixel + draw.normal(0, noise, pixel.shape)
            lost = draw.random(1200) < wrong
            pixel[lost] = draw.uniform(0, [640, 480], (1200, 2))[lost]
            tangents.append((pixel - cameras.centre[view].numpy()) / 570)
        essential = lens_estimate._essential(cameras, a, a + 1)
        found.append(Matches(tangents[0][seen], tangents[1][seen], essential, 570.0))
    return found


@pytest.mark.parametrize("k1", [0.03, -0.05])
def test_the_lens_that_was_dropped_is_found(k1: float) -> None:
    assert best_k1(matches(k1), CORNER) == pytest.approx(k1, abs=0.004)


def test_no_lens_is_found_where_there_is_none() -> None:
    assert best_k1(matches(0.0), CORNER) == 0
    # Matches that no lens explains, and too few of them.
    assert best_k1(matches(0.0, wrong=0.7), CORNER) == 0
    assert best_k1(matches(0.03)[:1], CORNER) == 0


def test_true_matches_lie_on_their_epipolar_lines() -> None:
    for each in matches(0.03, noise=0.0, wrong=0.0):
        assert np.abs(distances(each, 0.03)).max() < 1e-3 < np.abs(distances(each, 0.0)).max() - 0.5


def test_views_with_a_lens_keep_it() -> None:
    cameras = views(2)
    cameras.lens[1] = 2
    cameras.distortion[1, 0] = 0.5
    changed = with_k1(cameras, 0.02)
    assert changed.lens.tolist() == [1, 2] and changed.distortion[:, 0].tolist() == [0.02, 0.5]
    assert with_k1(cameras, 0.0) is cameras


def test_captures_with_a_lens_are_not_read(scene: ParsedScene) -> None:
    lenses = replace(scene, cameras=with_k1(scene.cameras, 0.02), paths=())
    assert estimate_k1(lenses) == 0
    assert estimate_k1(replace(scene, paths=(), train=scene.train[:3])) == 0


def test_photographs_of_a_lens_tell_it(scene: ParsedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random triangles in space, photographed through a lens that the cameras do not name."""
    cameras = views(4)
    draw = np.random.default_rng(2)
    points = torch.from_numpy(draw.uniform([-4, -3, -9], [4, 3, -4], (900, 3)))
    tones = draw.integers(40, 255, (900, 3))
    shapes = draw.uniform(-9, 9, (900, 3, 2))
    images = []
    for view in range(4):
        image = np.full((480, 640, 3), 20, np.uint8)
        pixel = project(with_k1(cameras, 0.05), torch.full((900,), view), points)[0].numpy()
        for place, tone, shape in zip(pixel - 0.5, tones, shapes, strict=True):
            corners = (16 * (place + shape)).round().astype(np.int32)
            cv2.fillPoly(image, [corners], tone.tolist(), cv2.LINE_AA, 4)
        images.append(image)
    monkeypatch.setattr(
        lens_estimate, "load_images", lambda scene, background, views: [images[v] for v in views]
    )
    monkeypatch.setattr(lens_estimate, "_MIN_MATCHES", 300)
    spots = replace(scene, cameras=cameras, train=torch.arange(4), test=torch.arange(0), paths=())
    assert estimate_k1(spots) == pytest.approx(0.05, abs=0.01)


def test_a_run_is_of_cameras_with_the_lens(config: GaussiansConfig, scene: ParsedScene) -> None:
    seen = replace(config, k1=0.1).calibrated(scene).cameras
    assert seen.lens.tolist() == [1] * len(seen) and float(seen.distortion[0, 0]) == 0.1
