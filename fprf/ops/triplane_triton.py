"""Tri-planes on a CUDA device: one launch over all planes and scales, forward and backward. Conventions:
`triplane`.

Triton comes with torch for CUDA. A program takes BLOCK points through all scales and planes; LANES is the
number of channels rounded up to a power of two. Resolutions are constants of the compiled code, so that
strides and borders cost nothing.

Gradients are summed up by atomic additions, whose order differs from run to run: bits may differ, within
rounding.
"""

# triton has no types, and what is passed to device code is none of Python's.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator"

from collections.abc import Sequence
from typing import Annotated, Any

import torch
import triton
import triton.language as tl
from torch import Tensor

_TILE = 1024
"""Numbers of a program's tile: channels times points."""


def forward(
    points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> Annotated[Tensor, "N scales*F"]:
    """Look up contiguous points in a contiguous table."""
    out = torch.empty(len(points), len(resolutions) * table.shape[1], device=points.device)
    _launch(_forward, points, table, out, resolutions)
    return out


def backward(
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
    grad: Annotated[Tensor, "N scales*F"],
) -> Annotated[Tensor, "rows F"]:
    """Gradient of the table for that of the lookup."""
    out = torch.zeros_like(table)
    _launch(_backward, points, table, out, resolutions, grad.contiguous())
    return out


def _launch(
    kernel: Any, points: Tensor, table: Tensor, out: Tensor, resolutions: Sequence[int], *more: Tensor
) -> None:
    if len(points) > 0:
        lanes = 1 << (table.shape[1] - 1).bit_length()
        block = max(1, _TILE // lanes)
        with torch.cuda.device(points.device):  # launches go to the current one
            kernel[(-(-len(points) // block),)](
                points, table, out, *more, len(points), tuple(resolutions), table.shape[1], lanes, block
            )


@triton.jit
def _nodes(points, n, inside, axis, SIZE: tl.constexpr):
    """Along one axis: the lower node, int64, and the share of the next one. NaN falls on the lower border."""
    at = (tl.load(points + n * 3 + axis, mask=inside, other=0.0) + 1.0) * (0.5 * (SIZE - 1))
    at = tl.where(at > 0.0, tl.minimum(at, SIZE - 1.0), 0.0)
    low = tl.minimum(tl.floor(at), SIZE - 2.0)
    return low.to(tl.int64), (at - low)[:, None]


@triton.jit
def _sample(table, row, c, mask, u, v, SIZE: tl.constexpr, CHANNELS: tl.constexpr):
    """Bilinear sample of a plane between four rows of the table, along the plane's rows first."""
    corner = table + row[:, None] * CHANNELS + c[None, :]
    a = tl.load(corner, mask=mask, other=0.0)
    b = tl.load(corner + CHANNELS, mask=mask, other=0.0)
    low = a * (1.0 - u) + b * u
    a = tl.load(corner + SIZE * CHANNELS, mask=mask, other=0.0)
    b = tl.load(corner + (SIZE + 1) * CHANNELS, mask=mask, other=0.0)
    return low * (1.0 - v) + (a * (1.0 - u) + b * u) * v


@triton.jit
def _spread(out, row, c, mask, u, v, slope, SIZE: tl.constexpr, CHANNELS: tl.constexpr):
    """Add the gradient of a sample to its four rows. Others add to them at the same time, in any order."""
    corner = out + row[:, None] * CHANNELS + c[None, :]
    low = slope * (1.0 - v)
    high = slope * v
    tl.atomic_add(corner, low * (1.0 - u), mask=mask, sem="relaxed")
    tl.atomic_add(corner + CHANNELS, low * u, mask=mask, sem="relaxed")
    tl.atomic_add(corner + SIZE * CHANNELS, high * (1.0 - u), mask=mask, sem="relaxed")
    tl.atomic_add(corner + (SIZE + 1) * CHANNELS, high * u, mask=mask, sem="relaxed")


@triton.jit
def _rows(points, n, inside, START, SIZE: tl.constexpr):
    """Rows of the first corners in the planes of one scale, and the shares along the three axes."""
    i, u = _nodes(points, n, inside, 0, SIZE)
    j, v = _nodes(points, n, inside, 1, SIZE)
    k, w = _nodes(points, n, inside, 2, SIZE)
    return (
        START + j * SIZE + i,
        START + SIZE * SIZE + k * SIZE + i,
        START + 2 * SIZE * SIZE + k * SIZE + j,
        u,
        v,
        w,
    )


@triton.jit(do_not_specialize=["count"])
def _forward(
    points,
    table,
    out,
    count,
    SIZES: tl.constexpr,
    CHANNELS: tl.constexpr,
    LANES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """out [count scales CHANNELS] = products of the samples."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    c = tl.arange(0, LANES)
    inside = n < count
    mask = inside[:, None] & (c < CHANNELS)[None, :]
    start = 0
    for scale in tl.static_range(len(SIZES)):
        first, second, third, u, v, w = _rows(points, n, inside, start, SIZES[scale])
        value = _sample(table, first, c, mask, u, v, SIZES[scale], CHANNELS)
        value *= _sample(table, second, c, mask, u, w, SIZES[scale], CHANNELS)
        value *= _sample(table, third, c, mask, v, w, SIZES[scale], CHANNELS)
        tl.store(out + (n[:, None] * len(SIZES) + scale) * CHANNELS + c[None, :], value, mask=mask)
        start += 3 * SIZES[scale] * SIZES[scale]


@triton.jit(do_not_specialize=["count"])
def _backward(
    points, table, out, grad, count,
    SIZES: tl.constexpr, CHANNELS: tl.constexpr, LANES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add the table's gradient to out, for the gradient grad [count scales CHANNELS] of the products."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    c = tl.arange(0, LANES)
    inside = n < count
    mask = inside[:, None] & (c < CHANNELS)[None, :]
    start = 0
    for scale in tl.static_range(len(SIZES)):
        slope = tl.load(
            grad + (n[:, None] * len(SIZES) + scale) * CHANNELS + c[None, :], mask=mask, other=0.0
        )
        first, second, third, u, v, w = _rows(points, n, inside, start, SIZES[scale])
        x = _sample(table, first, c, mask, u, v, SIZES[scale], CHANNELS)
        y = _sample(table, second, c, mask, u, w, SIZES[scale], CHANNELS)
        z = _sample(table, third, c, mask, v, w, SIZES[scale], CHANNELS)
        _spread(out, first, c, mask, u, v, slope * y * z, SIZES[scale], CHANNELS)
        _spread(out, second, c, mask, u, w, slope * x * z, SIZES[scale], CHANNELS)
        _spread(out, third, c, mask, v, w, slope * x * y, SIZES[scale], CHANNELS)
        start += 3 * SIZES[scale] * SIZES[scale]
