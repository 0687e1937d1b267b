"""Layout, labels, views: the same classes in every town, cameras that stand free and see enough of each other's scene."""

import numpy as np
import pytest

from benchmarks.town.layout import build_town
from benchmarks.town.render import geometry, walk
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
