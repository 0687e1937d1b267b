"""Block layouts in unit-cube coordinates."""

from typing import Annotated

import torch
from torch import Tensor

from ..interfaces import BlockLayout

__all__ = ["SingleLayout"]


class SingleLayout(BlockLayout):
    """One block over everything."""

    @property
    def boxes(self) -> Annotated[Tensor, "1 2 3"]:
        """The unit cube."""
        return torch.tensor([[[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]])

    def blend(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N 1"]:
        """Weight 1 everywhere."""
        return points.new_ones(len(points), 1)
