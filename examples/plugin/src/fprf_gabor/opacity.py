"""The loss. Letters as in `fprf.types`."""

from __future__ import annotations

import torch
from torch import Tensor

from fprf.interfaces import LossTerm, Parts
from fprf.types import Batch, Rendered, Want

__all__ = ["OpacityTerm"]


class OpacityTerm(LossTerm):
    """Mean over rays of 4 o (1 - o), o = the sum of a ray's weights.

    Its gradient is finite for every o; that of the entropy is not where o is 0 or 1.
    """

    @property
    def needs(self) -> Want:
        """The weights, which are always there."""
        return Want.DENSITY

    def __call__(
        self, rendered: Rendered, batch: Batch, parts: Parts, *, step: int, generator: torch.Generator | None
    ) -> Tensor:
        """The term, in [0, 1]."""
        assert rendered.weights is not None
        opacity = rendered.weights.sum(1)
        return (4 * opacity * (1 - opacity)).mean()
