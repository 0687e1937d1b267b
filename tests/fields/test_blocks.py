"""Block layouts: one block is the whole scene."""

import torch

from fprf.fields.blocks import SingleLayout
from fprf.fields.layouts import SingleConfig
from fprf.testing import check_layout


def test_the_contract() -> None:
    check_layout(SingleConfig())
    assert isinstance(SingleConfig().build(), SingleLayout)


def test_one_block_covers_the_cube_with_weight_one() -> None:
    layout = SingleConfig().build()
    assert torch.equal(layout.boxes, torch.tensor([[[-1.0] * 3, [1.0] * 3]]))
    points = torch.randn(30, 3, dtype=torch.float64)
    assert torch.equal(layout.blend(points), torch.ones(30, 1, dtype=torch.float64))
    assert layout.blend(points[:0]).shape == (0, 1)
