"""Views, paths and cameras of the stage, whatever their number and size."""

from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_world import World, stage_of

from fprf.errors import DataError
from fprf.evaluation.town_truth import PARTS, places, short_path, shows, town_view
from fprf.town.surface import FACADE, FOLIAGE, LAWN, ROAD, SKY

FIXTURE = [HealthCheck.function_scoped_fixture]


def test_more_views_than_were_held_out_are_all_of_them(world: World) -> None:
    known = world.load().known
    stage = stage_of(world.load(), views=50, frames=0, longest=32)
    assert len(stage.shown) == len(known.test) == len(stage.truth)
    assert torch.equal(stage.views.pose, known.cameras.pose[list(known.test)])
    assert len(stage.passed) == len(stage.path) == 0


def test_views_are_spread_over_what_was_held_out(world: World) -> None:
    trained = world.load()
    every = replace(trained, known=replace(trained.known, test=(1, 3, 5, 7, 9)))
    stage = stage_of(every, views=2, frames=8, longest=16)
    assert torch.equal(stage.views.pose, trained.known.cameras.pose[[1, 5]])
    assert torch.equal(stage.path.pose[0], stage.views.pose[1]), "the path begins in the middle"


@settings(max_examples=20, deadline=None, suppress_health_check=FIXTURE)
@given(frames=st.integers(1, 12), stride=st.floats(0.1, 8.0))
def test_paths_begin_where_they_are_told_and_step_evenly(world: World, frames: int, stride: float) -> None:
    start = world.load().known.cameras.select(torch.tensor([2]))
    path = short_path(start, frames, stride)
    assert len(path) == frames and torch.equal(path.pose[0], start.pose[0])
    step = (path.pose[1:, :, 3] - path.pose[:-1, :, 3]).norm(dim=1)
    assert torch.allclose(step, torch.full_like(step, 0.12 * stride)), "metres"
    assert torch.allclose(torch.linalg.det(path.pose[:, :, :3]), torch.ones(frames, dtype=torch.float64))


@settings(max_examples=20, deadline=None, suppress_health_check=FIXTURE)
@given(off=st.floats(0.02, 5.0), axis=st.integers(0, 1))
def test_cameras_that_a_town_does_not_have_are_refused(world: World, off: float, axis: int) -> None:
    cameras = world.load().known.cameras
    factor = torch.ones(2, dtype=torch.float64)
    factor[axis] += off
    with pytest.raises(DataError, match="no centred pinhole with square pixels at 32x24"):
        town_view(replace(cameras, focal=cameras.focal * factor), 1)
    bent = replace(cameras, lens=torch.ones_like(cameras.lens))
    with pytest.raises(DataError, match="view 1"):
        town_view(bent, 1)


def test_places_are_the_same_for_the_same_seeds() -> None:
    first, second = (places((7, 11, 13), (24, 18)) for _ in range(2))
    for a, b in zip(first["three"], second["three"], strict=True):
        assert (a.name, a.seed) == (b.name, b.seed) and (a.view.pose == b.view.pose).all()
    other = places((5, 11, 13), (24, 18))
    assert (other["one"][0].view.pose != first["one"][0].view.pose).any()
    assert (other["three"][1].view.pose == first["three"][1].view.pose).all(), "each town is searched by itself"


@given(st.lists(st.sampled_from([SKY, LAWN, ROAD, FACADE, FOLIAGE]), min_size=1, max_size=30))
def test_parts_share_a_picture(labels: list[int]) -> None:
    shown = {part: shows(torch.tensor([labels]).numpy(), part) for part in PARTS}
    assert all(0 <= share <= 1 for share in shown.values())
    known = sum(kind in (FACADE, LAWN, FOLIAGE) for kind in labels) / len(labels)
    assert shown["facades"] + shown["plants"] == pytest.approx(known)
    assert shown["street"] <= 2 * min(labels.count(SKY), labels.count(ROAD)) / len(labels) + 1e-12
