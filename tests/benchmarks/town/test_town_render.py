"""Colours: functions of point and palette alone; noise and patterns."""

import numpy as np
import pytest
from town_views import project, world

from benchmarks.town.layout import build_town
from benchmarks.town.palettes import PALETTES, palette
from benchmarks.town.render import colours, geometry, render, walk
from fprf.plugins.encoders.frozen import street

TOWN = build_town(0)
VIEWS = walk(seed=0, views=40, width=48, height=36)


@pytest.fixture(scope="module")
def pictures():
    return {name: [render(TOWN, VIEWS[k], look) for k in (0, 5, 11)] for name, look in PALETTES.items()}


def test_palettes_change_colours_only(pictures):
    for name, shots in pictures.items():
        for shot, day in zip(shots, pictures["day"], strict=True):
            assert shot.depth.tobytes() == day.depth.tobytes()
            assert shot.labels.tobytes() == day.labels.tobytes()
            difference = np.abs(shot.rgb.astype(int) - day.rgb).mean()
            assert (difference == 0) if name == "day" else (difference > 8)


def test_views_agree_on_colours():
    """What two cameras both see has the same colour in both, up to the pixels' footprints."""
    big = walk(seed=0, views=40, width=120, height=90)
    a, b = big[2], big[3]
    one, two = (colours(TOWN, view, palette("day"), 1) for view in (a, b))
    points, seen = world(a, geometry(TOWN, a)[0])
    row, column, distance = project(b, points)
    there = geometry(TOWN, b)[0][row, column]
    both = (row >= 0) & (np.abs(there - distance) < 0.02 * there)
    assert both.sum() > 1000
    difference = np.abs(one[seen] - two[row, column])[both].mean(1)
    assert np.median(difference) < 0.02 and difference.mean() < 0.05


def test_the_pictures_that_encoders_are_measured_on_are_the_towns():
    town, views = build_town(0), walk(seed=0, views=len(PALETTES), width=160, height=128)
    pictures = [render(town, view, look).rgb for view, look in zip(views, PALETTES.values(), strict=True)]
    assert np.array_equal((street() * 255).round().byte().permute(0, 2, 3, 1).numpy(), np.stack(pictures))
