"""Partitions of both kinds: blocks hold what cameras see and fit their budget, cells of Gaussians cover all
of space.
"""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from block_scenes import drone, street
from torch import Tensor

from fprf.blocks.config import AdaptiveConfig, BisectConfig, GridConfig, LayoutConfig, SingleConfig
from fprf.blocks.layouts import bounds
from fprf.blocks.partition import (
    make_plan,
    open_space,
    pixel_mask,
    read_cells,
    site_of,
    write_cells,
)
from fprf.blocks.routing import shares
from fprf.blocks.windows import cut_into_windows
from fprf.datamanagers.scene import ParsedScene, find_sightings
from fprf.errors import CheckpointError, ConfigError
from fprf.splats.cells import scene_in_windows
from fprf.types import Cell, Site


def site(scene: ParsedScene) -> Site:
    sightings = find_sightings(scene)
    return site_of(scene, open_space(scene, sightings), sightings)


DRONE = site(drone())
STREET = site(street())


def holding(cells: list[Cell], points: Tensor) -> Tensor:
    """Whether each point lies in some cell."""
    bare = [replace(cell, border=torch.zeros(3, dtype=torch.float64)) for cell in cells]
    return (shares(points, bare)[:, :-1] > 0).any(1)


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
        (BisectConfig(count=5), DRONE),
        (BisectConfig(), STREET),
    ],
    ids=str,
)
def test_cameras_stand_in_blocks_and_next_to_nothing_is_left_to_the_surroundings(
    layout: LayoutConfig, here: Site
) -> None:
    cells = layout.build().cut(here)
    assert bool(holding(cells, here.position).all())
    low, high = bounds(here)
    inside = here.points[((here.points >= low) & (here.points <= high)).all(1)]
    around = shares(inside, cells)[:, -1]
    assert float((around < 0.5).double().mean()) > 0.95


def test_bounds_of_more_points_than_quantiles_are_taken_of() -> None:
    many = torch.zeros(1, 3, dtype=torch.float64).expand((1 << 24) + 1, 3)
    low, high = bounds(DRONE._replace(points=many))
    assert bool(((low <= 0) & (high >= 0)).all())


def test_a_grid_has_equal_cells_that_share_faces() -> None:
    cells = GridConfig(cells=(3, 2)).build().cut(DRONE)
    assert len(cells) == 6
    sides = torch.stack([cell.high - cell.low for cell in cells])
    assert torch.allclose(sides, sides[:1].expand_as(sides))
    assert cells[0].high[1] == cells[1].low[1] and cells[0].high[0] == cells[2].low[0]
    assert float(cells[0].border[0]) == pytest.approx(0.1 * float(sides[0, :2].min()), rel=0.2)


@pytest.mark.parametrize("budget", [8_000, 30_000, 120_000])
def test_adaptive_blocks_fit_the_budget_or_cannot_be_split(budget: int) -> None:
    cells = AdaptiveConfig(rays=budget, smallest=1.0).build().cut(DRONE)
    total = int(DRONE.rays.sum())
    assert len(cells) >= total / budget
    low, high = bounds(DRONE)
    inside = DRONE.points[((DRONE.points >= low) & (DRONE.points <= high)).all(1)][:, :2]
    for cell in cells:
        first = cell.low[:2]
        last = cell.high[:2]
        cameras = ((DRONE.position[:, :2] >= first) & (DRONE.position[:, :2] < last)).all(1)
        points = ((inside >= first) & (inside < last)).all(1)
        load = 0.5 * float(DRONE.rays[cameras].sum()) + 0.5 * total * float(points.double().mean())
        assert load <= budget * 1.001


def test_each_block_sees_the_tiles_whose_rays_meet_it() -> None:
    scene = street()
    plan = make_plan(scene, GridConfig(cells=(4, 1)))
    behind = scene.cameras.pose[plan.views, 0, 3] > 75  # of cameras in the last quarter, which look ahead
    assert not plan.seen[behind, 0].any() and bool(plan.seen[behind, 3].any())
    for block in range(4):
        views = plan.views_of(block)
        seen = plan.seen[torch.isin(plan.views, views), block]
        assert sum(int(pixel_mask(each, (64, 48)).sum()) for each in seen) == int(plan.rays[block])


COUNT = 3


@pytest.fixture(scope="module", params=[drone, street])
def scene(request: pytest.FixtureRequest) -> ParsedScene:
    scene: ParsedScene = request.param()
    return scene


@pytest.fixture(scope="module")
def cells(scene: ParsedScene) -> list[Cell]:
    return cut_into_windows(scene, BisectConfig(count=COUNT))


def test_cells_cover_space_once_and_have_equally_many_sightings(
    scene: ParsedScene, cells: list[Cell]
) -> None:
    draw = torch.Generator().manual_seed(0)
    points = 1e3 * torch.randn(1000, 3, generator=draw, dtype=torch.float64) ** 3
    assert torch.stack([cell.holds(points) for cell in cells]).sum(0).eq(1).all()
    sightings = find_sightings(scene)
    assert sightings is not None
    found = torch.stack([cell.holds(sightings.point).double().mean() for cell in cells])
    assert (found - 1 / COUNT).abs().max() < 0.02


def test_windows_show_their_points_through_their_cameras(scene: ParsedScene, cells: list[Cell]) -> None:
    sightings = find_sightings(scene)
    assert sightings is not None
    for cell in cells:
        assert not {*cell.windows} - {*scene.train.tolist()}
        found = find_sightings(replace(scene_in_windows(scene, cell), seen=None))
        assert found is not None and {*found.view.tolist()} == {*cell.windows}
        mine = cell.holds(sightings.point)
        inside = torch.zeros_like(mine)
        for view, (left, top, width, height) in cell.windows.items():
            x, y = sightings.pixel.unbind(1)
            inside |= (
                (sightings.view == view) & (x >= left) & (x < left + width) & (y >= top) & (y < top + height)
            )
        assert inside[mine].double().mean() > 0.9  # outliers and views with few points are left out


def test_windows_of_a_photograph_reach_its_edges(scene: ParsedScene, cells: list[Cell]) -> None:
    for view in {view for cell in cells for view in cell.windows}:
        width, height = scene.cameras.size[view].tolist()
        windows = [cell.windows[view] for cell in cells if view in cell.windows]
        assert min(left for left, _, _, _ in windows) == min(top for _, top, _, _ in windows) == 0
        assert max(left + wide for left, _, wide, _ in windows) == width
        assert max(top + tall for _, top, _, tall in windows) == height


def test_without_points_cells_are_refused() -> None:
    with pytest.raises(ConfigError, match="too few points"):
        cut_into_windows(replace(drone(), points=None), BisectConfig())


@pytest.mark.parametrize("kind", ["blocks", "cells"])
def test_a_partition_comes_back_from_its_file(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "cells.json"
    if kind == "cells":
        cells = cut_into_windows(drone(), BisectConfig())
    else:
        cells = [*make_plan(drone(), GridConfig()).cells]
    assert not write_cells(file, cells) and not write_cells(file, cells)
    assert [*map(repr, read_cells(file))] == [*map(repr, cells)]
    assert write_cells(file, cells[:1]), "it held another one"
    for text in (
        "",
        '{"format": 2, "boxes": {}}',
        '{"format": 1, "boxes": {"low": [1], "high": [1], "turn": [1]}}',
    ):
        file.write_text(text)
        with pytest.raises(CheckpointError):
            read_cells(file)
