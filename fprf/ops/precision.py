"""Mathematics that autocast must not lower."""

import torch
from torch import Tensor

__all__ = ["full_precision"]


def full_precision(x: Tensor) -> torch.autocast:
    """Switches autocast off where x lies: attention in bfloat16 is off by 0.18 at |f|^2 = 1e4, styled features by 3 %."""
    return torch.autocast(x.device.type, enabled=False)
