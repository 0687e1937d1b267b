"""Small networks point by point: linear maps with ReLU between them.

The torch form is the reference for every device and dtype. Where nobody learns, on the CPU in float32, a
compiled kernel takes a block of points through all layers at once. Its sums run over the inputs in order, so
that a point's outputs are bitwise the same in any batch. In training kernels take one layer after the other,
forward and backward, twice as fast as torch's matrix products on a processor with vectors of 512 bits.

Part of the inputs may be shared by several points, as the direction of a ray is by its samples: given once,
looked up by row.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

import math
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from .backend import compiled_for

_OUTER_SLICES = 8  # parts of the points whose products are summed apart: two a thread on four cores

Floats = np.ndarray[tuple[int], np.dtype[np.float32]]


def usable(*tensors: Tensor, learns: bool | None = None) -> bool:
    """Return whether kernels without gradients apply: float32 on the CPU, not empty, numba installed, and
    nothing `learns` (None = as gradients are enabled).
    """
    if torch.is_grad_enabled() if learns is None else learns:
        return False
    return compiled_for(*tensors) and all(x.numel() > 0 for x in tensors)


def usable_in_training(*tensors: Tensor) -> bool:
    """Return whether the kernels of networks that learn apply: float32 on the CPU, not empty, gradients
    enabled.
    """
    return torch.is_grad_enabled() and compiled_for(*tensors) and all(x.numel() > 0 for x in tensors)


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
    the kernels errs by at most (I + 3) u (|x| |W|^T + |b|), u = 2^-24, and so do gradients of inputs; those of
    weights by (N + 3) u |g|^T |x|.
    """
    if not usable(x, *weights, *(bias for bias in biases if bias is not None)):
        if usable_in_training(x, *weights):
            return _learning(x, weights, biases, shared, row)
        return _network_reference(x, weights, biases, shared, row)
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


def _network_reference(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    shared: Tensor | None,
    row: Tensor | None,
) -> Tensor:
    if shared is not None and row is not None:
        x = torch.cat([x, shared.index_select(0, row)], -1)
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        x = torch.nn.functional.linear(x.relu_() if layer > 0 else x, weight, bias)
    return x


def _learning(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    shared: Tensor | None,
    row: Tensor | None,
) -> Tensor:
    """The network by kernels, layer by layer, so that all it is made of can learn."""
    first, *rest = weights
    side = None
    if shared is not None:
        # What points share is multiplied once.
        inputs = x.shape[1]
        side = torch.nn.functional.linear(shared, first[:, inputs:])
        first = first[:, :inputs]
    given = (x.contiguous(), side, row, len(weights), first, *rest, *biases)
    found: Tensor = _Network.apply(*given)  # type: ignore[no-untyped-call]
    return found


class _Network(torch.autograd.Function):
    """Linear maps with ReLU between them; of the first, rows of `side` are added to the outputs. What each
    map is given is kept for the gradients.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, side: Tensor | None, row: Tensor | None, layers: int, *given: Tensor | None
    ) -> Tensor:
        weights = [weight for weight in given[:layers] if weight is not None]
        inputs = []
        for layer, (weight, bias) in enumerate(zip(weights, given[layers:], strict=True)):
            inputs.append(x)
            floor = 0.0 if layer < layers - 1 else -math.inf
            if layer == 0 and side is not None and row is not None:
                x = _linear(x, weight.T, bias, floor=floor, side=side, row=row)
            else:
                x = _linear(x, weight.T, bias, floor=floor)
        ctx.shared = 0 if side is None else len(side)
        ctx.save_for_backward(row, *inputs, *weights)
        return x

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        row, *kept = ctx.saved_tensors
        layers = len(kept) // 2
        inputs = kept[:layers]
        weights = kept[layers:]
        wanted = ctx.needs_input_grad
        grad = grads[0].contiguous()
        to_weights: list[Tensor | None] = [None] * layers
        to_biases: list[Tensor | None] = [None] * layers
        for layer in reversed(range(layers)):
            if wanted[4 + layer]:
                to_weights[layer] = _outer(grad, inputs[layer])
            if wanted[4 + layers + layer]:
                to_biases[layer] = grad.sum(0)
            if layer > 0:
                # ReLU passes gradients where its outputs, the inputs of this layer, are above 0.
                grad = _linear(grad, weights[layer], None, mask=inputs[layer])
        to_x = to_side = None
        if wanted[0]:
            to_x = _linear(grad, weights[0], None)
        if wanted[1]:
            to_side = grad.new_zeros(ctx.shared, grad.shape[1]).index_add_(0, row, grad)
        return to_x, to_side, None, None, *to_weights, *to_biases


def _linear(
    x: Annotated[Tensor, "N I"],
    weight: Annotated[Tensor, "I O"],
    bias: Annotated[Tensor, "O"] | None,
    *,
    floor: float = -math.inf,
    side: Annotated[Tensor, "P O"] | None = None,
    row: Annotated[Tensor, "N"] | None = None,
    mask: Annotated[Tensor, "N O"] | None = None,
) -> Annotated[Tensor, "N O"]:
    """max(x weight + bias + side[row], floor), 0 where the mask is not above 0."""
    from . import dense_kernels as kernels
    from .simd import WIDE

    inputs, outputs = weight.shape
    width = -(-outputs // WIDE) * WIDE
    shift = weight.new_zeros(outputs) if bias is None else bias
    shift = torch.cat([_fitted(shift[None], 1, width)[0], weight.new_full((1,), floor)])
    none = x.new_empty(0)
    out = torch.empty(len(x), outputs)
    kernels.linear(
        array(x), array(_fitted(weight, inputs, width)), array(shift),
        array(none if side is None else _fitted(side, len(side), width)),
        torch.empty(0, dtype=torch.int64).numpy() if row is None else row.contiguous().numpy(),
        array(none if mask is None else mask), out.view(-1).numpy(),
    )  # fmt: skip
    return out


def _outer(grad: Annotated[Tensor, "N O"], x: Annotated[Tensor, "N I"]) -> Annotated[Tensor, "O I"]:
    """grad^T x; the sums are taken in parts whose number does not depend on the machine."""
    from . import dense_kernels as kernels
    from .simd import WIDE

    outputs = grad.shape[1]
    inputs = x.shape[1]
    if outputs % kernels.OUTER_ROWS or inputs % WIDE:
        return grad.T @ x
    parts = torch.zeros(_OUTER_SLICES, outputs, inputs)
    kernels.outer(array(grad), outputs, array(x), inputs, _OUTER_SLICES, parts.view(-1).numpy())
    return parts.sum(0)


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
