"""What scenes of another renderer are lit and shown by; its pictures where it is installed."""

import numpy as np
import pytest

from benchmarks.sun_traced import SCENES, Tracer, cie_overcast, direction_of, exposed, orbit


def test_a_level_plane_receives_pi_under_the_overcast_sky_and_thrice_as_much_comes_from_overhead() -> None:
    sky = cie_overcast(256)[..., 0].astype(np.float64)
    rise = np.pi / 2 - np.pi * (np.arange(256) + 0.5) / 256
    solid = np.cos(rise) * (np.pi / 256) ** 2
    received = (sky * (solid * np.maximum(np.sin(rise), 0))[:, None]).sum()
    assert received == pytest.approx(np.pi, rel=1e-3)
    assert sky[0, 0] / sky[127, 0] == pytest.approx(3.0, rel=0.03) and sky[128:].max() == 0


def test_exposure_leaves_a_twentieth_brighter_than_four_fifths() -> None:
    light = np.random.default_rng(0).gamma(2.0, 3.0, (2, 30, 40, 3)).astype(np.float32)
    things = np.ones((2, 1200), np.bool_)
    things[:, :600] = False
    shown = exposed(light, things).reshape(2, 1200, 3)[things].max(-1)
    white = 1.055 * 0.8 ** (1 / 2.4) - 0.055
    assert float((shown > white).mean()) == pytest.approx(0.05, abs=2e-3)
    assert np.allclose(exposed(7 * light, things), exposed(light, things), atol=1e-5)


def test_cameras_look_at_the_scene_and_stand_level() -> None:
    for pose in orbit(16, 3):
        turn = pose[:, :3]
        assert np.allclose(turn.T @ turn, np.eye(3)) and np.linalg.det(turn) == pytest.approx(1.0)
        assert turn[2, 0] == pytest.approx(0.0) and turn[2, 1] > 0
        reach = -pose[:, 3] @ pose[:, 2] * -1
        assert np.linalg.norm(pose[:, 3] - reach * pose[:, 2]) < 1.5
    assert direction_of(90.0, 30.0) == pytest.approx([0.0, 3**0.5 / 2, 0.5])


def test_the_renderer_s_sun_shines_from_where_it_is_said_to() -> None:
    pytest.importorskip("mitsuba", reason="the package mitsuba is not installed")
    tracer = Tracer(SCENES["yard"](), 0)
    pose = orbit(8, 0)[2]
    points, there = tracer.points(pose)
    assert there.mean() > 0.3 and points[there][:, 2].min() > -1e-3
    picture = tracer.picture(pose, tracer.sunsky(direction_of(35.0, 20.0)), 4)
    assert picture.shape == (120, 160, 3) and np.isfinite(picture).all()
    assert picture[there].mean() > 0
