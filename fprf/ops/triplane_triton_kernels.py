"""The device code behind `triplane_triton`. Conventions are those of `triplane`; arrays are contiguous.

A program takes `BLOCK` points through all scales and planes; `LANES` is the number of channels rounded up to a power of two.
Resolutions are constants of the compiled code, so that strides and borders cost nothing. Tables may be stored in half
precision; coordinates, arithmetic and sums are float32. One build serves any number of points: `count` is not specialised.
"""

# triton has no types, and what is passed to device code is none of Python's.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator"

import triton
import triton.language as tl


@triton.jit
def _nodes(points, n, inside, axis, SIZE: tl.constexpr):
    """Along one axis: the lower node, int64, and the share of the next one. NaN falls on the lower border."""
    at = (tl.load(points + n * 3 + axis, mask=inside, other=0.0) + 1.0) * (0.5 * (SIZE - 1))
    at = tl.where(at > 0.0, tl.minimum(at, SIZE - 1.0), 0.0)
    low = tl.minimum(tl.floor(at), SIZE - 2.0)
    return low.to(tl.int64), at - low


@triton.jit
def _sample(table, row, c, mask, u, v, SIZE: tl.constexpr, CHANNELS: tl.constexpr):
    """Bilinear sample of a plane between four rows of the table, along the plane's rows first."""
    corner = table + row[:, None] * CHANNELS + c[None, :]
    a = tl.load(corner, mask=mask, other=0.0).to(tl.float32)
    b = tl.load(corner + CHANNELS, mask=mask, other=0.0).to(tl.float32)
    low = a * (1.0 - u) + b * u
    a = tl.load(corner + SIZE * CHANNELS, mask=mask, other=0.0).to(tl.float32)
    b = tl.load(corner + (SIZE + 1) * CHANNELS, mask=mask, other=0.0).to(tl.float32)
    return low * (1.0 - v) + (a * (1.0 - u) + b * u) * v


@triton.jit
def _feature(points, table, n, c, inside, mask, START, SIZE: tl.constexpr, CHANNELS: tl.constexpr):
    """Product of the three samples of one scale, [BLOCK LANES]."""
    i, u = _nodes(points, n, inside, 0, SIZE)
    j, v = _nodes(points, n, inside, 1, SIZE)
    k, w = _nodes(points, n, inside, 2, SIZE)
    u, v, w = u[:, None], v[:, None], w[:, None]
    value = _sample(table, START + j * SIZE + i, c, mask, u, v, SIZE, CHANNELS)
    value *= _sample(table, START + SIZE * SIZE + k * SIZE + i, c, mask, u, w, SIZE, CHANNELS)
    return value * _sample(table, START + 2 * SIZE * SIZE + k * SIZE + j, c, mask, v, w, SIZE, CHANNELS)


@triton.jit(do_not_specialize=["count"])
def forward(points, table, out, count, SIZES: tl.constexpr, CHANNELS: tl.constexpr, LANES: tl.constexpr, BLOCK: tl.constexpr):
    """out [count scales CHANNELS] = products of the samples."""
    n, c = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, LANES)
    inside = n < count
    mask = inside[:, None] & (c < CHANNELS)[None, :]
    start = 0
    for scale in tl.static_range(len(SIZES)):
        value = _feature(points, table, n, c, inside, mask, start, SIZES[scale], CHANNELS)
        tl.store(out + (n[:, None] * len(SIZES) + scale) * CHANNELS + c[None, :], value, mask=mask)
        start += 3 * SIZES[scale] * SIZES[scale]


@triton.jit
def _spread(out, row, c, mask, u, v, slope, SIZE: tl.constexpr, CHANNELS: tl.constexpr):
    """Add the gradient of a sample to its four rows. Others add to them at the same time, in any order."""
    corner = out + row[:, None] * CHANNELS + c[None, :]
    low, high = slope * (1.0 - v), slope * v
    tl.atomic_add(corner, low * (1.0 - u), mask=mask, sem="relaxed")
    tl.atomic_add(corner + CHANNELS, low * u, mask=mask, sem="relaxed")
    tl.atomic_add(corner + SIZE * CHANNELS, high * (1.0 - u), mask=mask, sem="relaxed")
    tl.atomic_add(corner + (SIZE + 1) * CHANNELS, high * u, mask=mask, sem="relaxed")


@triton.jit
def _spread_product(
    points, table, out, n, c, inside, mask, slope, START, SIZE: tl.constexpr, CHANNELS: tl.constexpr
):  # fmt: skip
    """Add the gradient of `_feature` to the rows of its three samples, each times the other two."""
    i, u = _nodes(points, n, inside, 0, SIZE)
    j, v = _nodes(points, n, inside, 1, SIZE)
    k, w = _nodes(points, n, inside, 2, SIZE)
    u, v, w = u[:, None], v[:, None], w[:, None]
    first, second, third = START + j * SIZE + i, START + SIZE * SIZE + k * SIZE + i, START + 2 * SIZE * SIZE + k * SIZE + j
    x = _sample(table, first, c, mask, u, v, SIZE, CHANNELS)
    y = _sample(table, second, c, mask, u, w, SIZE, CHANNELS)
    z = _sample(table, third, c, mask, v, w, SIZE, CHANNELS)
    _spread(out, first, c, mask, u, v, slope * y * z, SIZE, CHANNELS)
    _spread(out, second, c, mask, u, w, slope * x * z, SIZE, CHANNELS)
    _spread(out, third, c, mask, v, w, slope * x * y, SIZE, CHANNELS)


@triton.jit(do_not_specialize=["count"])
def backward(
    points, table, grad, out, count,
    SIZES: tl.constexpr, CHANNELS: tl.constexpr, LANES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add the table's gradient to out, for the gradient grad [count scales CHANNELS] of the features."""
    n, c = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK), tl.arange(0, LANES)
    inside = n < count
    mask = inside[:, None] & (c < CHANNELS)[None, :]
    start = 0
    for scale in tl.static_range(len(SIZES)):
        slope = tl.load(grad + (n[:, None] * len(SIZES) + scale) * CHANNELS + c[None, :], mask=mask, other=0.0)
        _spread_product(points, table, out, n, c, inside, mask, slope, start, SIZES[scale], CHANNELS)
        start += 3 * SIZES[scale] * SIZES[scale]
