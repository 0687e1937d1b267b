"""Small networks point by point: linear maps with ReLU between them.

The torch form is the reference for every device and dtype. Where nobody learns, on the CPU in float32, a
compiled kernel takes a block of points through all layers at once. Its sums run over the inputs in order, so
that a point's outputs are bitwise the same in any batch.

Part of the inputs may be shared by several points, as the direction of a ray is by its samples: given once,
looked up by row.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from .backend import compiled_for

Floats = np.ndarray[tuple[int], np.dtype[np.float32]]


def usable(*tensors: Tensor, learns: bool | None = None) -> bool:
    """Return whether kernels without gradients apply: float32 on the CPU, not empty, numba installed, and
    nothing `learns` (None = as gradients are enabled).
    """
    if torch.is_grad_enabled() if learns is None else learns:
        return False
    return compiled_for(*tensors) and all(x.numel() > 0 for x in tensors)


def array(x: Tensor) -> Floats:
    """A tensor on the CPU as kernels take it: flat and contiguous."""
    numbers: Floats = x.detach().contiguous().view(-1).numpy()
    return numbers


def network(
    x: Annotated[Tensor, "N I"],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    shared: Annotated[Tensor, "P J"] | None = None,
    row: Annotated[Tensor, "N"] | None = None,
) -> Annotated[Tensor, "N O"]:
    """x W^T + b layer after layer, with ReLU between them.

    Weights are [outputs, inputs]. Point n has the inputs x[n] and behind them shared[row[n]]. Each layer of
    the kernel errs by at most (I + 3) u (|x| |W|^T + |b|), u = 2^-24.
    """
    if not usable(x, *weights, *(bias for bias in biases if bias is not None)):
        if shared is not None and row is not None:
            x = torch.cat([x, shared.index_select(0, row)], -1)
        for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            x = torch.nn.functional.linear(x.relu_() if layer > 0 else x, weight, bias)
        return x
    from . import dense_kernels as kernels
    from .simd import WIDE

    # Outputs are padded to whole vectors, which the next layer meets with zeros.
    packed = []
    shifts = []
    widths = []
    side = weights[0].new_empty(0)
    inputs = x.shape[1]
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        width = -(-len(weight) // WIDE) * WIDE
        if k == 0 and shared is not None:
            side = _fitted(shared @ weight[:, inputs:].T, len(shared), width)
        packed.append(_fitted(weight[:, :inputs].T if k == 0 else weight.T, inputs, width).reshape(-1))
        shifts.append(_fitted((weight.new_zeros(len(weight)) if bias is None else bias)[None], 1, width)[0])
        widths.append(width)
        inputs = width
    rows = torch.empty(0, dtype=torch.int64) if row is None else row.contiguous()
    out = torch.empty(len(x), len(weights[-1]))
    kernels.network(
        array(x), x.shape[1], array(torch.cat(packed)), array(torch.cat(shifts)), np.asarray(widths), array(side),
        rows.numpy(), out.view(-1).numpy(), out.shape[1],
    )  # fmt: skip
    return out


def runs(x: Annotated[Tensor, "N C"]) -> tuple[Annotated[Tensor, "P"], Annotated[Tensor, "N"]]:
    """Rows that stand for the runs of equal rows, and the run of each row: x[first][run] is x.

    Only on the CPU in float32; elsewhere each row stands for itself.
    """
    if not (compiled_for(x) and x.numel() > 0):
        every = torch.arange(len(x), device=x.device)
        return every, every
    begins = torch.nn.functional.pad((x[1:] != x[:-1]).any(1), (1, 0), value=True)
    return begins.nonzero()[:, 0], begins.cumsum(0) - 1


def _fitted(x: Tensor, rows: int, columns: int) -> Tensor:
    return torch.nn.functional.pad(x, (0, columns - x.shape[1], 0, rows - len(x)))
