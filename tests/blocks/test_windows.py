"""Weights of blocks: a partition of unity, continuous, local, and right at faces, corners and bends."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pretend_cuda import CUDA, pretend_cuda
from torch import Tensor

from fprf.blocks.routing import local, shares, window
from fprf.types import Boxes


def grid(columns: int, rows: int, margin: float = 0.2, side: float = 1.0) -> Boxes:
    low = torch.tensor([[side * i, side * j, 0.0] for i in range(columns) for j in range(rows)], dtype=torch.float64)
    return Boxes(low, low + side, torch.eye(3, dtype=torch.float64).expand(len(low), 3, 3), margin)


def turned(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


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


def test_faces_share_evenly_and_reach_is_the_margin() -> None:
    boxes = grid(2, 1, 0.2)
    at = torch.tensor(
        [[1.0, 0.5, 0.5], [0.6, 0.5, 0.5], [0.9, 0.5, 0.5], [0.5, 0.5, 1.0], [0.5, 0.5, 1.2], [5.0, 5.0, 5.0]]
    ).double()
    weight = shares(at, boxes)
    assert weight[0].tolist() == pytest.approx([0.5, 0.5, 0.0])
    assert weight[1].tolist() == pytest.approx([1.0, 0.0, 0.0])
    assert float(weight[2, 1]) == pytest.approx(0.15625, abs=1e-6), "smoothstep of a quarter"
    assert weight[3].tolist() == pytest.approx([0.5, 0.0, 0.5]), "the upper face fades into the surroundings"
    assert weight[4].tolist() == weight[5].tolist() == [0.0, 0.0, 1.0]


def test_corner_of_four_cells_is_a_quarter_each() -> None:
    weight = shares(torch.tensor([[1.0, 1.0, 0.5]]).double(), grid(2, 2, 0.2))
    assert weight[0].tolist() == pytest.approx([0.25] * 4 + [0.0])


@pytest.mark.parametrize("boxes", [grid(3, 2), bend()], ids=["grid", "bend"])
def test_weights_change_no_faster_than_the_margins_allow(boxes: Boxes) -> None:
    """Steepest slope of a smoothstep over two margins is 3 / (4 m) an axis; scaling at most doubles it."""
    draw = torch.Generator().manual_seed(3)
    start = torch.rand(4000, 3, dtype=torch.float64, generator=draw) * 6 - 2.5
    step = torch.nn.functional.normalize(torch.randn(4000, 3, dtype=torch.float64, generator=draw), dim=1) * 1e-3
    jump = (shares(start + step, boxes) - shares(start, boxes)).abs().amax(1)
    assert float(jump.max()) <= 1e-3 * math.sqrt(3) * 2 * 0.75 / boxes.margin + 1e-12
    assert float(jump.max()) > 0, "the test crosses a border"


def test_a_bend_has_no_gap_where_segments_overlap() -> None:
    boxes = bend()
    inner = torch.tensor([[0.0, 0.4, 1.0], [0.1, 0.6, 1.0], [-0.2, 0.5, 1.0]]).double()
    weight = shares(inner, boxes)
    assert torch.allclose(weight.sum(1), torch.ones(3).double(), atol=1e-12)
    assert bool((weight[:, 2] < 0.05).all())


def test_float32_far_from_the_origin_keeps_the_blend() -> None:
    """A scene 600 units wide: float32 steps there are 6e-5, so weights may be off by that over the margin."""
    boxes = grid(2, 1, 0.2)
    shift = torch.tensor([600.0, -300.0, 0.0], dtype=torch.float64)
    moved = Boxes(boxes.low + shift, boxes.high + shift, boxes.turn, 0.2)
    points = torch.rand(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2 - 0.5
    exact, found = shares(points, boxes), shares((points + shift).float(), moved)
    assert float((found - exact).abs().max()) < 3 * 6.2e-5 / 0.2
    assert torch.allclose(found.sum(1), torch.ones(500), atol=1e-6)


def test_no_blocks_are_surroundings_and_no_points_are_none() -> None:
    none = Boxes(*(torch.zeros(0, 3).double() for _ in range(2)), torch.zeros(0, 3, 3).double(), 0.1)
    assert shares(torch.zeros(4, 3), none).tolist() == [[1.0]] * 4
    assert shares(torch.zeros(0, 3), grid(2, 1)).shape == (0, 3)


def test_on_cuda_places_are_no_products_of_matrices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which TF32 would round."""
    points, turn = torch.randn(50, 3), turned(0.3)
    expected = local(points, turn)
    monkeypatch.setattr(torch.Tensor, "__matmul__", None, raising=False)
    with pretend_cuda():
        found = local(points.to(CUDA), turn.to(CUDA)).cpu()
    assert (found - expected).abs().max() <= 1e-6
