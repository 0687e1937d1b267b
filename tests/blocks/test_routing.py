"""Routers and weights of blocks: a partition of unity, continuous, local; every point in one group."""

import math

import pytest
import torch
from block_scenes import cell, grid, points_around, row
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.blocks.routing import BlendRouter, Group, chart_of, shares, surroundings_of, window
from fprf.types import Cell

UNEVEN = [cell((0, 0, 0), (2, 3, 1), 0.25), cell((2, 0, 0), (5, 1, 1), 0.25), cell((2, 1, 0), (5, 3, 1), 0.25)]
"""As bisection leaves them: a face of one is shared by two."""


def dense(groups: list[Group], points: int, members: int) -> torch.Tensor:
    """Groups as a table of weights."""
    weight = torch.zeros(points, members, dtype=torch.float64)
    for group in groups:
        columns = torch.tensor(group.members)
        share = torch.ones(len(group.at), 1) if group.weight is None else group.weight
        weight[group.at[:, None], columns[None]] = share.double()
    return weight


@settings(max_examples=5, deadline=None)
@given(st.sampled_from([row(1), row(4), row(3, 0.9), grid(3, 3), UNEVEN]), st.integers(0, 2**31 - 1))
def test_blending_is_what_the_windows_say(cells: list[Cell], seed: int) -> None:
    points = points_around(cells, 400, seed)
    groups = BlendRouter(cells)(points)
    assert sorted(torch.cat([g.at for g in groups]).tolist()) == list(range(400)), "each point in one group"
    found, wanted = dense(groups, 400, len(cells) + 1), shares(points, cells).double()
    # What is left out is slight, and float32 windows round by 1e-6 or so of a margin.
    assert float((found - wanted).abs().max()) < 1e-5
    assert torch.allclose(found.sum(1), torch.ones(400).double(), atol=1e-6)
    for group in groups:
        assert (group.weight is None) == (len(group.members) == 1)
        assert bool((group.at[1:] > group.at[:-1]).all()), "ascending"


def test_blocks_that_no_point_needs_are_not_named() -> None:
    blend = BlendRouter(row(5))
    named = {m for g in blend(torch.tensor([[3.0, 0.0, 0.5], [3.2, 0.3, 0.9], [3.1, 50.0, 0.0]])) for m in g.members}
    assert named == {1, 5}, "the second block, and the surroundings"
    far = blend(torch.tensor([[1e9, 0.0, 0.0], [-1e30, 1e30, 0.0], [float("nan"), 0.0, 0.0]]))
    assert [g.members for g in far] == [(5,)] and len(far[0].at) == 3


def test_a_chart_fills_the_cube_with_the_cell_and_its_border() -> None:
    for each in UNEVEN:
        chart = chart_of(each)
        ends = torch.stack([chart.low, chart.high])
        assert torch.allclose(chart.locate(ends), torch.tensor([[-1.0] * 3, [1.0] * 3]).double(), atol=1e-9)
        middle = (each.low + each.high)[None] / 2
        assert torch.allclose(chart.locate(middle), torch.zeros(1, 3).double(), atol=1e-12)
        assert bool(chart.inside(middle))


def test_surroundings_hold_everything_and_blocks_fill_their_inner_half() -> None:
    around = surroundings_of(UNEVEN)
    assert around.contracted
    corners = torch.cat([torch.stack([each.low, each.high]) for each in UNEVEN])
    assert float(around.locate(corners).abs().max()) <= 0.5 + 1e-12
    far = around.locate(torch.tensor([[1e6, 0.0, 0.0], [0.0, -1e20, 3.0]]))
    assert bool((far.abs() <= 1).all()) and float(far[0, 0]) == pytest.approx(1.0, abs=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 3), st.integers(1, 3), st.floats(0.01, 0.5), st.integers(0, 2**31 - 1))
def test_weights_sum_to_one_and_need_no_scaling_in_a_grid(columns: int, rows: int, border: float, seed: int) -> None:
    cells = grid(columns, rows, border)
    draw = torch.Generator().manual_seed(seed)
    points = torch.rand(200, 3, dtype=torch.float64, generator=draw) * torch.tensor([columns + 2.0, rows + 2.0, 3.0]) - 1
    weight = shares(points, cells)
    assert weight.shape == (200, columns * rows + 1) and bool((weight >= 0).all())
    assert torch.allclose(weight.sum(1), torch.ones(200, dtype=torch.float64), atol=1e-12)
    bare = torch.stack([window(points, each) for each in cells], 1).sum(1)
    assert bool((bare <= 1 + 1e-12).all()), "windows of cells that share faces never sum to more than 1"
    inside = (points > 2 * border).all(1) & (points < torch.tensor([columns, rows, 1.0]) - 2 * border).all(1)
    assert torch.allclose(bare[inside], torch.ones(int(inside.sum())).double(), atol=1e-12), "no surroundings inside"


@pytest.mark.parametrize("cells", [grid(3, 2), UNEVEN], ids=["grid", "uneven"])
def test_weights_change_no_faster_than_the_borders_allow(cells: list[Cell]) -> None:
    """Steepest slope of a smoothstep over two borders is 3 / (4 b) an axis; scaling at most doubles it."""
    draw = torch.Generator().manual_seed(3)
    start = torch.rand(4000, 3, dtype=torch.float64, generator=draw) * 6 - 2.5
    step = torch.nn.functional.normalize(torch.randn(4000, 3, dtype=torch.float64, generator=draw), dim=1) * 1e-3
    jump = (shares(start + step, cells) - shares(start, cells)).abs().amax(1)
    assert float(jump.max()) <= 1e-3 * math.sqrt(3) * 2 * 0.75 / float(cells[0].border[0]) + 1e-12
    assert float(jump.max()) > 0, "the test crosses a border"
