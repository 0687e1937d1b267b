"""Layout, labels, views: the same classes in every town, cameras that stand free and see enough of each other's scene."""

import numpy as np
import pytest
from town_views import project, world

from benchmarks.town.layout import ROAD_HALF, build_town
from benchmarks.town.render import geometry, is_test, walk
from benchmarks.town.surface import CLASSES


def test_towns_are_functions_of_their_seed():
    for field in ("material", "tint", "origin", "extent"):
        a, b, c = (getattr(build_town(seed).faces, field) for seed in (1, 1, 2))
        assert np.array_equal(a, b)
        assert not np.array_equal(a, c)
    first, same, other = (walk(seed=s, views=4, width=8, height=8) for s in (1, 1, 2))
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(first, same, strict=True))
    assert not any(np.array_equal(a.pose, b.pose) for a, b in zip(first, other, strict=True))


@pytest.mark.parametrize("seed", [0, 1])
def test_every_town_shows_every_class(seed):
    town = build_town(seed)
    views = walk(seed=seed, views=40, width=40, height=30)
    seen = sum(np.bincount(geometry(town, view)[1].ravel(), minlength=len(CLASSES)) for view in views[::3])
    assert len(seen) == len(CLASSES) <= 12
    assert (seen > 14 * 1200 * 0.001).all(), dict(zip(CLASSES, seen, strict=True))


def test_cameras_are_rigid_upright_and_at_eye_level():
    views = walk(seed=3, views=40, width=160, height=120)
    for view in views:
        r = view.pose[:, :3]
        np.testing.assert_allclose(r.T @ r, np.eye(3), atol=1e-12)
        assert np.linalg.det(r) == pytest.approx(1)
        assert r[2, 0] == pytest.approx(0, abs=1e-12), "no roll"
        assert r[2, 1] > 0.9, "up is up"
        assert 1.5 <= view.pose[2, 3] <= 2.5
        assert abs(view.pose[1, 3]) < ROAD_HALF
    centres = np.stack([view.pose[:, 3] for view in views])
    assert np.ptp(centres[:, 0]) > 20
    assert np.ptp(centres[:, 1]) > 3
    assert [k for k in range(40) if is_test(k)] == [0, 8, 16, 24, 32]


def test_held_out_views_are_seen_by_three_training_views():
    town, views = build_town(0), walk(seed=0, views=40, width=64, height=48)
    depths = [geometry(town, view)[0] for view in views]
    counts = []
    for k in filter(is_test, range(40)):
        points, _ = world(views[k], depths[k])
        count = np.zeros(len(points), int)
        for j in (j for j in range(40) if not is_test(j)):
            row, column, distance = project(views[j], points)
            count += (row >= 0) & (np.abs(depths[j][row, column] - distance) < 0.1 + 0.05 * distance)
        counts.append(count)
    assert (np.concatenate(counts) >= 3).mean() >= 0.95
