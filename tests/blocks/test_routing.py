"""Routers: every point in one group, weights as windows say, no block named that no point needs."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.blocks.routing import Blend, Chart, Everywhere, Group, Inset, chart_of, shares, surroundings_of
from fprf.types import Boxes


def row(count: int, margin: float = 0.3) -> Boxes:
    low = torch.tensor([[2.0 * i, -1.0, 0.0] for i in range(count)], dtype=torch.float64)
    high = torch.tensor([[2.0 * i + 2, 1.0, 1.5] for i in range(count)], dtype=torch.float64)
    return Boxes(low, high, torch.eye(3, dtype=torch.float64).expand(count, 3, 3), margin)


def ring(count: int) -> Boxes:
    """Turned boxes around a circle."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    turn = torch.stack(
        [
            torch.stack([-angle.sin(), angle.cos(), zero], 1),
            torch.stack([-angle.cos(), -angle.sin(), zero], 1),
            torch.stack([zero, zero, one], 1),
        ],
        1,
    )
    centre = 5 * torch.stack([angle.cos(), angle.sin(), zero], 1)
    middle = (turn @ centre[:, :, None])[:, :, 0]
    half = torch.tensor([5 * math.pi / count, 1.0, 1.0], dtype=torch.float64)
    return Boxes(middle - half, middle + half, turn, 0.25)


def dense(groups: list[Group], points: int, members: int) -> torch.Tensor:
    """Groups as a table of weights."""
    weight = torch.zeros(points, members, dtype=torch.float64)
    for group in groups:
        columns = torch.tensor(group.members)
        share = torch.ones(len(group.at), 1) if group.weight is None else group.weight
        weight[group.at[:, None], columns[None]] = share.double()
    return weight


def spread(boxes: Boxes, count: int, seed: int) -> torch.Tensor:
    whole = surroundings_of(boxes)
    draw = torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return (whole.low - 1 + draw * (whole.high - whole.low + 2)).float()


@settings(max_examples=12, deadline=None)
@given(st.sampled_from([row(1), row(4), row(3, 0.9), ring(7), ring(16)]), st.integers(0, 2**31 - 1))
def test_blending_is_what_the_windows_say(boxes: Boxes, seed: int) -> None:
    points = spread(boxes, 400, seed)
    groups = Blend(boxes)(points)
    assert sorted(torch.cat([g.at for g in groups]).tolist()) == list(range(400)), "each point in one group"
    found, wanted = dense(groups, 400, len(boxes.low) + 1), shares(points, boxes).double()
    # What is left out is slight, and float32 windows round by 1e-6 or so of a margin.
    assert float((found - wanted).abs().max()) < 1e-5
    assert torch.allclose(found.sum(1), torch.ones(400).double(), atol=1e-6)
    for group in groups:
        assert (group.weight is None) == (len(group.members) == 1)
        assert bool((group.at[1:] > group.at[:-1]).all()), "ascending"


def test_blocks_that_no_point_needs_are_not_named() -> None:
    blend = Blend(row(5))
    named = {m for g in blend(torch.tensor([[3.0, 0.0, 0.5], [3.2, 0.3, 0.9], [3.1, 50.0, 0.0]])) for m in g.members}
    assert named == {1, 5}, "the second block, and the surroundings"
    far = blend(torch.tensor([[1e9, 0.0, 0.0], [-1e30, 1e30, 0.0], [float("nan"), 0.0, 0.0]]))
    assert [g.members for g in far] == [(5,)] and len(far[0].at) == 3


def test_no_points_are_no_trouble() -> None:
    assert all(not len(g.at) for g in Blend(row(2))(torch.zeros(0, 3)))
    assert not Inset(chart_of(row(2), 0))(torch.zeros(0, 3))


def test_insets_and_everywhere() -> None:
    boxes = row(3)
    points = spread(boxes, 300, 0)
    chart = chart_of(boxes, 1)
    groups = {g.members: g for g in Inset(chart)(points)}
    inside = chart.inside(points)
    assert torch.equal(groups[(0,)].at, inside.nonzero()[:, 0]) and torch.equal(groups[(1,)].at, (~inside).nonzero()[:, 0])
    only = Everywhere()(points)
    assert len(only) == 1 and only[0].members == (0,) and only[0].weight is None and len(only[0].at) == 300


def test_a_chart_fills_the_cube_with_the_cell_and_its_margin() -> None:
    boxes = ring(5)
    for block in range(5):
        chart = chart_of(boxes, block)
        ends = torch.stack([chart.low, chart.high]) @ chart.turn
        assert torch.allclose(chart.locate(ends), torch.tensor([[-1.0] * 3, [1.0] * 3]).double(), atol=1e-9)
        middle = ((boxes.low[block] + boxes.high[block]) / 2) @ boxes.turn[block]
        assert torch.allclose(chart.locate(middle[None]), torch.zeros(1, 3).double(), atol=1e-12)
        assert bool(chart.inside(middle[None]))


def test_surroundings_hold_everything_and_blocks_fill_their_inner_half() -> None:
    boxes = ring(6)
    around = surroundings_of(boxes)
    assert around.contracted
    corners = torch.cat([torch.stack([boxes.low[b], boxes.high[b]]) @ boxes.turn[b] for b in range(6)])
    assert float(around.locate(corners).abs().max()) <= 0.5 + 1e-12
    far = around.locate(torch.tensor([[1e6, 0.0, 0.0], [0.0, -1e20, 3.0]]))
    assert bool((far.abs() <= 1).all()) and float(far[0, 0]) == pytest.approx(1.0, abs=1e-5)


def test_charts_keep_float32_precision_in_a_wide_scene() -> None:
    low = torch.tensor([500.0, 20.0, 0.0], dtype=torch.float64)
    chart = Chart(low, low + 2, torch.eye(3, dtype=torch.float64))
    points = low + 2 * torch.rand(100, 3, dtype=torch.float64)
    error = (chart.locate(points.float()).double() - chart.locate(points)).abs().max()
    assert float(error) < 6.2e-5, "the rounding of the coordinate itself: half a step of float32 at 500"
