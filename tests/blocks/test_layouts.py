"""Layouts: cells that cover where cameras stand, fit their budget, follow their street."""

import math

import pytest
import torch
from block_scenes import drone, street
from torch import Tensor

from fprf.blocks.layouts import bounds
from fprf.blocks.plan import _COLOURS, BORDER, SIDE, make_plan, open_space, site_of, top_view
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


def test_a_grid_has_equal_cells_that_share_faces() -> None:
    boxes = GridConfig(cells=(3, 2)).build().cut(DRONE)
    assert len(boxes.low) == 6
    sides = boxes.high - boxes.low
    assert torch.allclose(sides, sides[:1].expand_as(sides))
    assert torch.equal(boxes.high[0, 1], boxes.low[1, 1]) and torch.equal(boxes.high[0, 0], boxes.low[2, 0])
    assert boxes.margin == pytest.approx(0.1 * float(sides[0, :2].min()), rel=0.2)


def test_the_top_view_shows_every_block_on_the_ground() -> None:
    scene = drone()
    picture = top_view(scene, make_plan(scene, GridConfig(cells=(3, 2))))
    assert max(picture.shape) == SIDE + 2 * BORDER
    for colour in _COLOURS:
        assert (picture == colour).all(-1).sum() > 1000


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
