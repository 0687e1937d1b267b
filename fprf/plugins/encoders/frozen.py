"""What every frozen encoder shares: padding that any size survives, and tensors that no optimiser sees."""

from typing import Annotated

import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["freeze", "reflect_pad", "replicate_to_multiple"]


def freeze(module: nn.Module) -> None:
    """Evaluation mode, no gradients to the weights."""
    module.eval()
    module.requires_grad_(False)


def reflect_pad(x: Annotated[Tensor, "B C H W"], margin: int = 1) -> Annotated[Tensor, "B C H+2m W+2m"]:
    """Mirror at the borders; repeat them where an axis is too short to mirror."""
    mirrored = min(x.shape[-2:]) > margin
    return F.pad(x, (margin, margin, margin, margin), mode="reflect" if mirrored else "replicate")


def replicate_to_multiple(x: Annotated[Tensor, "B C H W"], stride: int) -> Tensor:
    """Repeat the last row and column until both axes are multiples of `stride`."""
    right, below = -x.shape[-1] % stride, -x.shape[-2] % stride
    return F.pad(x, (0, right, 0, below), mode="replicate") if right or below else x
