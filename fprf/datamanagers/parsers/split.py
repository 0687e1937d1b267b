"""Which views are held out."""

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["every_eighth", "indices"]


def every_eighth(count: int) -> tuple[Tensor, Tensor]:
    """Indices (train, test), int64, of `count` views sorted by name: every 8th, from the first on, is test (LLFF).

    A single view is for training, so that there is something to learn from.
    """
    index = torch.arange(count)
    test = (index % 8 == 0) & (count > 1)
    return index[~test], index[test]


def indices(members: Sequence[bool]) -> Tensor:
    """The int64 positions of the members."""
    return torch.tensor([k for k, member in enumerate(members) if member], dtype=torch.int64)
