"""Styles at points without gradients: what a mixture of maps makes of the features of each.

Each has a plain form, the reference for every device and dtype (within `backend.plain`, for all), and one compiled for float32
on the CPU.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from .dense import array, usable
from .precision import full_precision


def affine(
    x: Annotated[Tensor, "N C"],
    share: Annotated[Tensor, "N K"],
    matrix: Annotated[Tensor, "K C C"],
    bias: Annotated[Tensor, "K C"],
    *,
    centre: Annotated[Tensor, "C"],
) -> Annotated[Tensor, "N C"]:
    """sum_k share_k ((x - centre) matrix_k + bias_k); maps that a point has no share in are not computed.

    Within (C + K + 3) u sum_k share_k (|x - centre| |matrix_k| + |bias_k|), u = 2^-24.
    """
    if not usable(x):
        with full_precision(x):
            x = x - centre
            if len(matrix) == 1:
                return x @ matrix[0] + bias[0]
            mixed = share @ bias
            for k in range(len(matrix)):
                inside = share[:, k].nonzero().squeeze(1)
                mixed.index_add_(0, inside, (x[inside] * share[inside, k, None]) @ matrix[k])
            return mixed
    from . import mixture_kernels as kernels

    out = torch.empty(len(x), x.shape[1])
    padded = [_whole(part) for part in (matrix, bias)]
    kernels.affine(*(array(part) for part in (x, centre, share, *padded)), x.shape[1], padded[1].shape[1], out.view(-1).numpy())
    return out


def scaled(
    x: Annotated[Tensor, "N C"],
    share: Annotated[Tensor, "N K"],
    gain: Annotated[Tensor, "K C"],
    bias: Annotated[Tensor, "K C"],
    *,
    centre: Annotated[Tensor, "C"],
) -> Annotated[Tensor, "N C"]:
    """(x - centre) (share gain) + share bias, channel by channel: the mixture's gains and biases.

    Within (K + 2) u (|x - centre| share |gain| + share |bias|), u = 2^-24.
    """
    if not usable(x):
        with full_precision(x):
            return (x - centre) * (share @ gain) + share @ bias
    from . import mixture_kernels as kernels

    out = torch.empty(len(x), x.shape[1])
    padded = [_whole(part) for part in (gain, bias)]
    width = padded[0].shape[1]
    given = [array(part) for part in (x, centre, share, *padded)]
    kernels.scaled(*given, x.shape[1], width, np.zeros(width, np.float32), out.view(-1).numpy())
    return out


def _whole(x: Tensor) -> Tensor:
    """The last axis padded with zeros to whole vectors."""
    from .simd import WIDE

    return torch.nn.functional.pad(x, (0, -x.shape[-1] % WIDE))
