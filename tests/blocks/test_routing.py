"""Routers and weights of blocks: a partition of unity, continuous, local; every point in one group."""

import math

import pytest
import torch
from block_scenes import boxes_in_a_row as row
from block_scenes import points_around
from hypothesis import given, settings
from hypothesis import strategies as st
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.blocks.routing import Blend, Group, chart_of, local, shares, surroundings_of, window
from fprf.types import Boxes


def turned(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def ring(count: int) -> Boxes:
    """Turned boxes around a circle."""
    turn = torch.stack([turned(2 * math.pi * k / count) for k in range(count)])
    middle = torch.tensor([[0.0, -5.0, 0.0]], dtype=torch.float64).repeat(count, 1)
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


@settings(max_examples=5, deadline=None)
@given(st.sampled_from([row(1), row(4), row(3, 0.9), ring(7), ring(16)]), st.integers(0, 2**31 - 1))
def test_blending_is_what_the_windows_say(boxes: Boxes, seed: int) -> None:
    points = points_around(boxes, 400, seed)
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


def grid(columns: int, rows: int, margin: float = 0.2, side: float = 1.0) -> Boxes:
    low = torch.tensor([[side * i, side * j, 0.0] for i in range(columns) for j in range(rows)], dtype=torch.float64)
    return Boxes(low, low + side, torch.eye(3, dtype=torch.float64).expand(len(low), 3, 3), margin)


def bend() -> Boxes:
    """Two segments that meet at 60 degrees and overlap on the inner side."""
    low, high = torch.tensor([[-2.0, -1.0, 0.0], [0.0, -1.0, 0.0]]).double(), torch.tensor([[0.0, 1, 2], [2.0, 1, 2]]).double()
    return Boxes(low, high, torch.stack([turned(0.0), turned(math.pi / 3)]), 0.3)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 3), st.integers(1, 3), st.floats(0.01, 0.5), st.integers(0, 2**31 - 1))
def test_weights_sum_to_one_and_need_no_scaling_in_a_grid(columns: int, rows: int, margin: float, seed: int) -> None:
    boxes = grid(columns, rows, margin)
    draw = torch.Generator().manual_seed(seed)
    points = torch.rand(200, 3, dtype=torch.float64, generator=draw) * torch.tensor([columns + 2.0, rows + 2.0, 3.0]) - 1
    weight = shares(points, boxes)
    assert weight.shape == (200, columns * rows + 1) and bool((weight >= 0).all())
    assert torch.allclose(weight.sum(1), torch.ones(200, dtype=torch.float64), atol=1e-12)
    bare = torch.stack([window(points, boxes, z) for z in range(columns * rows)], 1).sum(1)
    assert bool((bare <= 1 + 1e-12).all()), "windows of cells that share faces never sum to more than 1"
    inside = (points > 2 * margin).all(1) & (points < torch.tensor([columns, rows, 1.0]) - 2 * margin).all(1)
    assert torch.allclose(bare[inside], torch.ones(int(inside.sum())).double(), atol=1e-12), "no surroundings inside"


@pytest.mark.parametrize("boxes", [grid(3, 2), bend()], ids=["grid", "bend"])
def test_weights_change_no_faster_than_the_margins_allow(boxes: Boxes) -> None:
    """Steepest slope of a smoothstep over two margins is 3 / (4 m) an axis; scaling at most doubles it."""
    draw = torch.Generator().manual_seed(3)
    start = torch.rand(4000, 3, dtype=torch.float64, generator=draw) * 6 - 2.5
    step = torch.nn.functional.normalize(torch.randn(4000, 3, dtype=torch.float64, generator=draw), dim=1) * 1e-3
    jump = (shares(start + step, boxes) - shares(start, boxes)).abs().amax(1)
    assert float(jump.max()) <= 1e-3 * math.sqrt(3) * 2 * 0.75 / boxes.margin + 1e-12
    assert float(jump.max()) > 0, "the test crosses a border"


def test_on_cuda_places_are_no_products_of_matrices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which TF32 would round."""
    points, turn = torch.randn(50, 3), turned(0.3)
    expected = local(points, turn)
    monkeypatch.setattr(torch.Tensor, "__matmul__", None, raising=False)
    with pretend_cuda():
        found = local(points.to(CUDA), turn.to(CUDA)).cpu()
    assert (found - expected).abs().max() <= 1e-6
