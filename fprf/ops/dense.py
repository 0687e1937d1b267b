"""Small networks point by point: linear maps with ReLU between them.

The torch form is the reference for every device and dtype; on the CPU in float32 compiled kernels take a block of points
through all layers at once, there and back. Sums run over the inputs in order, so a point's outputs are bitwise the same in any
batch; gradients are summed up over points in one order for any number of threads.

Part of the inputs may be shared by several points, as the direction of a ray is by its samples: given once, looked up by row.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import triplane, triplane_numba
from .backend import compiled

__all__ = ["Last", "network", "network_reference", "plane_network", "runs", "usable"]

Last = Literal["linear", "relu"]
"""What happens to the last layer's outputs."""

Floats = np.ndarray[tuple[int], np.dtype[np.float32]]


def usable(x: Tensor) -> bool:
    """Float32 on the CPU, nobody wants gradients, and numba is installed."""
    return _fit(x) and not torch.is_grad_enabled()


def _fit(x: Tensor) -> bool:
    return compiled() and x.device.type == "cpu" and x.dtype == torch.float32


def network_reference(
    x: Annotated[Tensor, "N I"],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    shared: Annotated[Tensor, "P J"] | None = None,
    row: Annotated[Tensor, "N"] | None = None,
    last: Last = "linear",
) -> Annotated[Tensor, "N O"]:
    """ReLU(x W^T + b) layer after layer, and after the last what `last` says.

    Weights are [outputs, inputs]. Point n has the inputs x[n] and behind them shared[row[n]].
    """
    if shared is not None and row is not None:
        x = torch.cat([x, shared.index_select(0, row)], -1)
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        x = torch.nn.functional.linear(x.relu() if layer > 0 else x, weight, bias)
    return x.relu() if last == "relu" else x


def network(
    x: Annotated[Tensor, "N I"],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    shared: Annotated[Tensor, "P J"] | None = None,
    row: Annotated[Tensor, "N"] | None = None,
    last: Last = "linear",
) -> Annotated[Tensor, "N O"]:
    """`network_reference` by the fastest form that this device and dtype have; `shared` gets no gradient.

    Each layer of the kernels errs by at most (I + 3) u (|x| |W|^T + |b|), u = 2^-24.
    """
    given = (x, *weights, *(bias for bias in biases if bias is not None))
    if not all(_fit(part) for part in given) or len(x) == 0:
        return network_reference(x, weights, biases, shared=shared, row=row, last=last)
    if torch.is_grad_enabled() and any(part.requires_grad for part in given):
        found: Tensor = _Network.apply(x, shared, row, last, len(weights), *weights, *biases)  # type: ignore[no-untyped-call]
        return found
    return _forward(x, weights, biases, shared, row, last, x.new_empty(0))


def plane_network(
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    *,
    shared: Annotated[Tensor, "P J"] | None = None,
    row: Annotated[Tensor, "N"] | None = None,
    last: Last = "linear",
) -> Annotated[Tensor, "N O"]:
    """`network` of the tri-plane features of points (`triplane.lookup`), which are never written where nobody learns."""
    fit = usable(points) and triplane_numba.usable(points, table) and all(_fit(weight) for weight in weights)
    if not fit or len(points) == 0:
        return network(triplane.lookup(points, table, resolutions), weights, biases, shared=shared, row=row, last=last)
    from . import dense_kernels as kernels

    assert points.shape[1] == 3
    out = torch.empty(len(points), len(weights[-1]))
    planes = (_flat(table), table.shape[1], *triplane_numba.layout(resolutions))
    layers = _packed(len(resolutions) * table.shape[1], weights, biases, shared, row)
    kernels.plane_network(_flat(points), *planes, *layers, _KINDS[last], out.view(-1).numpy(), out.shape[1])
    return out


def runs(x: Annotated[Tensor, "N C"]) -> tuple[Annotated[Tensor, "P"], Annotated[Tensor, "N"]]:
    """Rows that stand for the runs of equal rows, and the run of each row: x[first][run] is x.

    Found on the CPU in float32; elsewhere each row stands for itself.
    """
    if _fit(x) and len(x) > 0:
        from . import dense_kernels as kernels

        first, run = torch.empty(len(x), dtype=torch.int64), torch.empty(len(x), dtype=torch.int64)
        return first[: kernels.runs(x.detach().contiguous().numpy(), first.numpy(), run.numpy())], run
    every = torch.arange(len(x), device=x.device)
    return every, every


_KINDS = {"linear": 0, "relu": 1}


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, shared: Tensor | None, row: Tensor | None, last: Last, layers: int, *parameters: Tensor | None
    ) -> Tensor:
        weights, biases = [p for p in parameters[:layers] if p is not None], parameters[layers:]
        hidden = torch.empty(len(x) * sum(_whole(len(weight)) for weight in weights[:-1]))
        out = _forward(x, weights, biases, shared, row, last, hidden)
        ctx.save_for_backward(x, shared, row, hidden, out, *parameters)
        ctx.last, ctx.layers = last, layers
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        x, shared, row, hidden, out, *parameters = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        learns = any(wanted[5:])
        found = _gradients(x, shared, row, hidden, out, parameters[: ctx.layers], ctx.last, grads[0], wanted[0], learns)
        parts: list[Tensor | None] = [*found.weights, *found.biases] if learns else [None] * len(parameters)
        kept = [part if want else None for part, want in zip(parts, wanted[5:], strict=True)]
        return found.x, None, None, None, None, *kept


class _Found(NamedTuple):
    x: Tensor | None
    weights: list[Tensor]
    biases: list[Tensor]


def _forward(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor | None],
    shared: Tensor | None,
    row: Tensor | None,
    last: Last,
    hidden: Tensor,
) -> Tensor:
    from . import dense_kernels as kernels

    out = torch.empty(len(x), len(weights[-1]))
    layers = _packed(x.shape[1], weights, biases, shared, row)
    kernels.network(_flat(x), x.shape[1], *layers, _KINDS[last], out.view(-1).numpy(), out.shape[1], hidden.numpy())
    return out


def _gradients(
    x: Tensor,
    shared: Tensor | None,
    row: Tensor | None,
    hidden: Tensor,
    out: Tensor,
    weights: Sequence[Tensor],
    last: Last,
    grad: Tensor,
    moves: bool,
    learns: bool,
) -> _Found:
    """Of the inputs, where they move, and of weights and biases, where they learn."""
    from . import dense_gradients as kernels
    from .lanes import BLOCK

    depths = [x.shape[1], *(_whole(len(weight)) for weight in weights[:-1])]
    widths = [_whole(len(weight)) for weight in weights]
    across = 0 if shared is None else shared.shape[1]
    turned = [weight[:, : x.shape[1]] if k == 0 else weight for k, weight in enumerate(weights)]
    transposed = [_fitted(weight, width, _whole(depth)) for weight, width, depth in zip(turned, widths, depths, strict=True)]
    sizes = [-(-depth // BLOCK) * BLOCK * width for depth, width in zip([*depths, across], [*widths, widths[0]], strict=True)]
    starts = np.cumsum([0, *sizes])
    shifts = starts[-1] + np.cumsum([0, *widths[:-1]])
    sums = torch.zeros(kernels.CHUNKS, int(starts[-1]) + sum(widths) if learns else 0)
    moved = torch.empty_like(x, memory_format=torch.contiguous_format) if moves else x.new_empty(0)
    kernels.gradients(
        _flat(x),
        x.shape[1],
        _flat(x.new_empty(0) if shared is None else shared),
        across,
        _rows(row),
        hidden.numpy(),
        np.asarray(widths),
        _flat(torch.cat([part.reshape(-1) for part in transposed])),
        _flat(out),
        out.shape[1],
        _KINDS[last],
        _flat(grad),
        sums.view(-1).numpy(),
        starts[:-1],
        shifts,
        learns,
        moved.view(-1).numpy(),
    )
    if not learns:
        return _Found(moved if moves else None, [], [])
    total = sums.sum(0)
    tables = [total[a : a + n].view(-1, w) for a, n, w in zip(starts, sizes, [*widths, widths[0]], strict=False)]
    found = [table[: turn.shape[1], : len(turn)].T for table, turn in zip(tables, turned, strict=False)]
    if across:
        found[0] = torch.cat([found[0], tables[-1][:across, : len(weights[0])].T], 1)
    biases = [total[a : a + len(weight)] for a, weight in zip(shifts, weights, strict=True)]
    return _Found(moved if moves else None, [each.contiguous() for each in found], biases)


def _packed(
    inputs: int, weights: Sequence[Tensor], biases: Sequence[Tensor | None], shared: Tensor | None, row: Tensor | None
) -> tuple[Any, ...]:
    """Layers as the kernels take them: outputs padded to whole vectors, which the next layer meets with zeros."""
    packed, shifts, widths, side = [], [], [], weights[0].new_empty(0)
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        width = _whole(len(weight))
        if k == 0 and shared is not None:
            side = _fitted(shared @ weight[:, inputs:].T, len(shared), width)
        packed.append(_fitted(weight[:, :inputs].T if k == 0 else weight.T, inputs, width).reshape(-1))
        shifts.append(_fitted((weight.new_zeros(len(weight)) if bias is None else bias)[None], 1, width)[0])
        widths.append(width)
        inputs = width
    return _flat(torch.cat(packed)), _flat(torch.cat(shifts)), np.asarray(widths), _flat(side), _rows(row)


def _whole(count: int) -> int:
    """Rounded up to whole vectors."""
    from .lanes import WIDE

    return -(-count // WIDE) * WIDE


def _fitted(x: Tensor, rows: int, columns: int) -> Tensor:
    return torch.nn.functional.pad(x, (0, columns - x.shape[1], 0, rows - len(x)))


def _rows(row: Tensor | None) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    found: np.ndarray[tuple[int], np.dtype[np.int64]] = (
        torch.empty(0, dtype=torch.int64) if row is None else row.contiguous()
    ).numpy()
    return found


def _flat(x: Tensor) -> Floats:
    flat: Floats = x.detach().contiguous().view(-1).numpy()
    return flat
