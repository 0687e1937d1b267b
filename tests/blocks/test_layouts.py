"""Layouts: cells that cover where cameras stand, fit their budget, follow their street."""

import math

import pytest
import torch
from block_scenes import drone, street
from torch import Tensor

from fprf.blocks.layouts import REACH, bounds, within
from fprf.blocks.plan import open_space, site_of
from fprf.blocks.routing import shares
from fprf.datamanagers.scene import Scene, find_sightings
from fprf.fields.layouts import AdaptiveConfig, GridConfig, LayoutConfig, SingleConfig, StreetConfig
from fprf.types import Boxes, Site


def site(scene: Scene) -> Site:
    return site_of(scene, open_space(scene, find_sightings(scene)))


DRONE, STREET = site(drone()), site(street())


def along(angle: Tensor, radius: float) -> Site:
    """Cameras on an arc, and points on both sides of it."""
    ring = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
    points = torch.cat([ring * (radius + d) for d in (-0.7, 0.7)])
    points[:, 2] = torch.linspace(-0.2, 0.8, len(points), dtype=points.dtype)
    return Site(radius * ring, torch.full((len(angle),), 1000), points, 8.0)


def holding(boxes: Boxes, points: Tensor) -> Tensor:
    """Whether each point lies in some cell."""
    return (shares(points, Boxes(boxes.low, boxes.high, boxes.turn, 0.0))[:, :-1] > 0).any(1)


@pytest.mark.parametrize(
    ("layout", "here"),
    [
        (SingleConfig(), DRONE),
        (GridConfig(), DRONE),
        (GridConfig(cells=(5, 3)), DRONE),
        (AdaptiveConfig(rays=20_000), DRONE),
        (SingleConfig(), STREET),
        (GridConfig(cells=(5, 1)), STREET),
        (AdaptiveConfig(rays=20_000), STREET),
        (StreetConfig(), STREET),
        (StreetConfig(length=20.0), STREET),
    ],
    ids=str,
)
def test_cameras_stand_in_blocks_and_next_to_nothing_is_left_to_the_surroundings(layout: LayoutConfig, here: Site) -> None:
    boxes = layout.build().cut(here)
    assert bool(holding(boxes, here.position).all())
    low, high = bounds(here)
    inside = here.points[((here.points >= low) & (here.points <= high)).all(1)]
    around = shares(inside, boxes)[:, -1]
    assert float((around < 0.5).double().mean()) > 0.95


def test_one_block_alone_is_not_cut() -> None:
    boxes = SingleConfig().build().cut(DRONE)
    assert len(boxes.low) == 1 and boxes.margin == 0
    assert not SingleConfig.cuts and GridConfig.cuts


def test_a_grid_has_equal_cells_that_share_faces() -> None:
    boxes = GridConfig(cells=(3, 2)).build().cut(DRONE)
    assert len(boxes.low) == 6
    sides = boxes.high - boxes.low
    assert torch.allclose(sides, sides[:1].expand_as(sides))
    assert torch.equal(boxes.high[0, 1], boxes.low[1, 1]) and torch.equal(boxes.high[0, 0], boxes.low[2, 0])
    assert boxes.margin == pytest.approx(0.1 * float(sides[0, :2].min()), rel=0.2)


def test_empty_cells_are_left_out() -> None:
    """A street along a diagonal leaves most of its square empty."""
    turn = torch.tensor(
        [[math.sqrt(0.5), -math.sqrt(0.5), 0.0], [math.sqrt(0.5), math.sqrt(0.5), 0.0], [0.0, 0.0, 1.0]]
    ).double()
    here = Site(STREET.position @ turn.T, STREET.rays, STREET.points @ turn.T, STREET.unit)
    boxes = GridConfig(cells=(6, 6)).build().cut(here)
    assert 6 <= len(boxes.low) < 24
    assert bool(holding(boxes, here.position).all())


@pytest.mark.parametrize("budget", [8_000, 30_000, 120_000])
def test_adaptive_blocks_fit_the_budget_or_cannot_be_split(budget: int) -> None:
    boxes = AdaptiveConfig(rays=budget, smallest=1.0).build().cut(DRONE)
    total = int(DRONE.rays.sum())
    assert len(boxes.low) >= total / budget
    low, high = bounds(DRONE)
    inside = DRONE.points[((DRONE.points >= low) & (DRONE.points <= high)).all(1)][:, :2]
    for z in range(len(boxes.low)):
        first, last = boxes.low[z, :2], boxes.high[z, :2]
        cameras = ((DRONE.position[:, :2] >= first) & (DRONE.position[:, :2] < last)).all(1)
        points = ((inside >= first) & (inside < last)).all(1)
        load = 0.5 * float(DRONE.rays[cameras].sum()) + 0.5 * total * float(points.double().mean())
        assert load <= budget * 1.001


def test_adaptive_blocks_are_smaller_where_cameras_are_dense() -> None:
    spread = torch.rand(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.5
    crowd = DRONE.position.mean(0) + 0.1 * spread * (DRONE.position.amax(0) - DRONE.position.amin(0))
    dense = torch.cat([DRONE.position, crowd])
    here = Site(dense, torch.full((len(dense),), 3000), DRONE.points, DRONE.unit)
    boxes = AdaptiveConfig(rays=60_000).build().cut(here)
    area = (boxes.high - boxes.low)[:, :2].prod(1)
    at = shares(crowd, boxes)[:, :-1].argmax(1)
    assert float(area[at].mean()) < 0.5 * float(area.mean())


def test_another_budget_moves_no_block_that_it_does_not_split() -> None:
    """So that blocks trained already are kept."""
    coarse = AdaptiveConfig(rays=60_000).build().cut(DRONE)
    fine = AdaptiveConfig(rays=30_000).build().cut(DRONE)
    assert coarse.margin == fine.margin and len(fine.low) > len(coarse.low)
    faces = {tuple(row) for row in fine.low.tolist()} | {tuple(row) for row in fine.high.tolist()}
    assert all(tuple(row) in faces for row in coarse.low.tolist())


def test_nothing_is_split_below_the_smallest_side() -> None:
    boxes = AdaptiveConfig(rays=1, smallest=15.0).build().cut(DRONE)
    assert float((boxes.high - boxes.low)[:, :2].min()) * DRONE.unit >= 15.0 - 1e-9


@pytest.mark.parametrize("segments", [1, 2, 3, 5, 8])
def test_a_straight_street_is_cut_into_equal_segments_in_a_row(segments: int) -> None:
    boxes = StreetConfig(segments=segments).build().cut(STREET)
    assert len(boxes.low) == segments
    for z in range(segments - 1):
        # The street winds a little, and so do its segments.
        face = (boxes.turn[z].T @ torch.stack([boxes.high[z, 0], *boxes.low[z, 1:]]))[0]
        assert float(face) == pytest.approx(
            float((boxes.turn[z + 1].T @ torch.stack([boxes.low[z + 1, 0], *boxes.low[z, 1:]]))[0]), abs=0.15
        )
    if segments > 2:
        inner = (boxes.high - boxes.low)[1:-1, 0]
        assert float(inner.max() / inner.min()) < 1.2


def test_a_street_driven_there_and_back_is_cut_once() -> None:
    there = STREET.position
    back = Site(torch.cat([there, there.flip(0)]), STREET.rays.repeat(2), STREET.points, STREET.unit)
    one, two = (StreetConfig(segments=4).build().cut(s) for s in (STREET, back))
    assert torch.allclose(one.low, two.low, atol=1e-6) and torch.allclose(one.high, two.high, atol=1e-6)


def test_segments_turn_with_the_street() -> None:
    here = along(torch.linspace(0, math.pi / 2, 60, dtype=torch.float64), 6.0)
    boxes = StreetConfig(length=2.5 * here.unit).build().cut(here)
    assert 4 <= len(boxes.low) <= 8
    direction = torch.atan2(boxes.turn[:, 0, 1], boxes.turn[:, 0, 0])
    assert float((direction.max() - direction.min()).abs()) > 0.8
    assert bool(holding(boxes, here.position).all())
    # Everywhere along the path blocks have the say, not the surroundings.
    assert float(shares(here.position, boxes)[:, -1].max()) < 0.02
    extent = (boxes.high - boxes.low)[:, 1]
    assert float(extent.max()) < 4.5, "no segment is as wide as the whole bend"


def test_the_region_reaches_beyond_the_cameras_but_no_farther_than_points() -> None:
    cameras = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]], dtype=torch.float64)
    points = torch.rand(2000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [20.0, 0.4, 0.5]
    )
    low, high = bounds(Site(cameras, torch.ones(2).long(), points.double(), 1.0))
    assert float(high[0]) == pytest.approx(4 + REACH, abs=0.3)
    assert -0.1 < float(low[1]) <= 0 and 0.4 <= float(high[1]) < 0.5, "points end before the reach does"
    few = Site(cameras, torch.ones(2).long(), points[:3].double(), 1.0)
    assert bounds(few)[0].tolist() == [-1.0, -1.0, -1.0], "three points say nothing"


def test_a_stray_point_does_not_widen_the_region() -> None:
    strays = torch.cat([STREET.points, torch.tensor([[5.0, -0.9, 0.0]]).double()])
    low, high = within(Site(STREET.position, STREET.rays, strays, STREET.unit), *bounds(STREET))
    assert torch.allclose(low, bounds(STREET)[0], atol=0.05) and torch.allclose(high, bounds(STREET)[1], atol=0.05)
