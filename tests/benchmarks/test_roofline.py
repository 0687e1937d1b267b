import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.roofline import backward_bytes, bandwidth, forward_bytes, touched
from fprf.evaluation.report import Watch
from fprf.ops import triplane


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(2, 7), min_size=1, max_size=3), st.integers(1, 20), st.integers(0, 99))
def test_touched_rows_are_those_that_a_gradient_reaches(resolutions: list[int], count: int, seed: int) -> None:
    """Points inside of cells touch four rows of each plane; none of their weights is zero."""
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 1.98 - 0.99
    table = torch.rand(triplane.rows(resolutions), 1, dtype=torch.float64).add_(0.5).requires_grad_()
    triplane.lookup_reference(points, table, resolutions).sum().backward()  # type: ignore[no-untyped-call]
    assert table.grad is not None
    assert touched(points, resolutions) == int((table.grad.abs().sum(1) > 0).sum())


def test_bytes_of_one_point() -> None:
    points, table = torch.zeros(1, 3), torch.zeros(triplane.rows((5, 9)), 8)
    row = 8 * 4
    forward = 3 * 4 + 2 * 3 * 4 * row + 2 * row
    assert forward_bytes(points, table, (5, 9)) == forward
    assert backward_bytes(points, table, (5, 9)) == forward + table.numel() * 4 + 2 * 2 * 3 * 4 * row


def test_a_copy_has_a_speed() -> None:
    assert 1e7 < bandwidth(Watch(2, torch.device("cpu")), 1 << 20) < 1e14


def test_more_points_than_rows_touch_each_row_once() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(5000, 3, generator=generator) * 2 - 1
    assert touched(points, (4,)) == triplane.rows((4,)) == pytest.approx(48)
