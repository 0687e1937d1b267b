"""From a raw network value to a density: exp, with a gradient that neither explodes nor dies."""

from typing import Annotated, Any

import torch
from torch import Tensor

__all__ = ["LIMIT", "density"]

LIMIT = 15.0
"""exp(15) = 3e6 per space unit is opaque within a micro-unit; beyond it only the gradient could overflow."""


class _Exp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(max=LIMIT).exp()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        result: Tensor = grads[0] * x.clamp(-LIMIT, LIMIT).exp()
        return result


def density(raw: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """exp(raw - 1), capped at exp(15): the start is thin, so that light reaches the whole scene (K-Planes)."""
    result: Tensor = _Exp.apply(raw - 1)  # type: ignore[no-untyped-call]
    return result
