"""The compiled loops behind `triplane`. Conventions are those of `triplane`; arrays are flat, contiguous
float32.
"""

# numba passes the typing context of an intrinsic by itself, which the checker cannot know: call-arg.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .simd import (
    BLOCK,
    NARROW,
    WIDE,
    exp2,
    load,
    maximum,
    minimum,
    narrow,
    repeat,
    splat,
    store,
    total,
    traced,
)
from .threads import cached_jit

AXES = ((0, 1), (0, 2), (1, 2))
"""Those of `triplane`, which imports this module."""
LOG2_E = 1 / np.log(2)
"""exp(x) is 2 to this times x."""
LEAST_EXPONENT = -87.0
"""exp(-87) stands for all smaller numbers."""
GROUP = 16
"""Channels of one backward task: a cache line of float32."""

_jit = cached_jit(parallel=True, nogil=True)
_PIECE = 512
"""Squares that are added in float32, 64 a lane, before float64 takes them: a regulariser needs no more."""


@numba.njit(inline="always")
def cells(points, first, count, size, start, channels, corner, part):
    """For `count` <= BLOCK points: first number of the lower corner's vector in each plane, share of the next
    node per axis.

    Outside counts as the border; the comparison is written so that NaN falls on the lower one: an index must
    never leave the table.
    """
    last = np.float32(size - 1)
    plane = size * size
    half = np.float32(0.5) * last
    top = np.float32(size - 2)
    for axis in range(3):
        for n in range(count):
            at = (points[3 * (first + n) + axis] + np.float32(1)) * half
            at = min(at, last) if at > np.float32(0) else np.float32(0)
            low = min(np.floor(at), top)
            part[axis * BLOCK + n] = at - low
            corner[axis * BLOCK + n] = np.int64(low)
    # Rows of the table by plane: (0, 1), (0, 2), (1, 2).
    for n in range(count):
        i = corner[n]
        j = corner[BLOCK + n]
        k = corner[2 * BLOCK + n]
        corner[n] = (start + j * size + i) * channels
        corner[BLOCK + n] = (start + plane + k * size + i) * channels
        corner[2 * BLOCK + n] = (start + 2 * plane + k * size + j) * channels


@traced
def exponential(x, at, limit, count):
    """x[at :] = exp(min(x[at :] - 1, limit)) for `count` numbers, whole vectors."""

    def step(k, held):
        raw = minimum(narrow(limit, WIDE), load(x, at + k, WIDE) - 1.0)
        raw = maximum(splat(x, LEAST_EXPONENT, WIDE), raw)
        # NaN stays: neither comparison takes it away, and the exponential of bits would.
        store(x, at + k, exp2(raw * LOG2_E) + raw * 0.0)
        return held

    repeat(count, [splat(x, 0.0, WIDE)], step, by=WIDE)


# The inner steps take several channels at a time: left to the compiler they are 3 times slower on 196 608
# points, forward and backward. Offsets are in numbers from the start of flat arrays; `step` and `stride` lead
# to the next node along the row and to the next row; u, v, w are the shares of the next nodes.


def _samples(table, bases, step, stride, shares):
    """Bilinear samples of the three planes, along the rows first, and the slopes of each along its axes."""

    def mix(low, high, share):
        return low * (1 - share) + high * share

    values = []
    slopes = []
    for base, (across, down) in zip(bases, AXES, strict=True):
        lanes = shares[0].lanes
        a = load(table, base, lanes)
        b = load(table, base + step, lanes)
        c = load(table, base + stride, lanes)
        d = load(table, base + stride + step, lanes)
        upper = mix(a, b, shares[across])
        lower = mix(c, d, shares[across])
        values.append(mix(upper, lower, shares[down]))
        slopes.append({across: mix(b - a, d - c, shares[down]), down: lower - upper})
    return values, slopes


def samples_of(table, bases, step, stride, shares):
    """Bilinear samples of the three planes, for other traced functions."""
    return _samples(table, bases, step, stride, shares)[0]


@traced
def product_forward(table, out, a, b, c, o, step, stride, u, v, w, lanes):
    """out[o : o + lanes] = sample(a; u, v) * sample(b; u, w) * sample(c; v, w)."""
    (x, y, z), _ = _samples(table, (a, b, c), step, stride, [narrow(share, lanes) for share in (u, v, w)])
    store(out, o, x * y * z)


@traced
def product_backward(table, grad, out, a, b, c, o, shift, step, stride, u, v, w, lanes):
    """Add to out[shift:], at the corners of a, b and c, the gradient of `product_forward` for grad[o : o +
    lanes].
    """
    shares = [narrow(share, lanes) for share in (u, v, w)]
    (x, y, z), _ = _samples(table, (a, b, c), step, stride, shares)
    g = load(grad, o, lanes)
    for base, (across, down), slope in zip((a, b, c), AXES, (g * y * z, g * x * z, g * x * y), strict=True):
        for row, along in ((base, 1 - shares[down]), (base + stride, shares[down])):
            for corner, share in ((row, 1 - shares[across]), (row + step, shares[across])):
                at = corner + shift
                store(out, at, load(out, at, lanes) + slope * along * share)


@traced
def product_slopes(table, grad, sums, a, b, c, o, step, stride, u, v, w):
    """Add to sums[0], [NARROW] and [2 NARROW] onwards grad[o :] times the slopes of `product_forward` along
    u, v and w.
    """
    (x, y, z), slopes = _samples(
        table, (a, b, c), step, stride, [narrow(share, NARROW) for share in (u, v, w)]
    )
    g = load(grad, o, NARROW)
    others = (y * z, x * z, x * y)
    for axis in range(3):
        first, second = (s[axis] * rest for s, rest in zip(slopes, others, strict=True) if axis in s)
        at = axis * NARROW
        store(sums, at, load(sums, at, NARROW) + g * (first + second))


@numba.njit(inline="always")
def _features(points, first, count, table, channels, sizes, starts, corner, part, out, to):
    """For `count` <= BLOCK points [3] the products of their samples, scales side by side, to out[to :]."""
    scales = len(sizes)
    for scale in range(scales):
        size = sizes[scale]
        cells(points, first, count, size, starts[scale], channels, corner, part)
        for n in range(count):
            a = corner[n]
            b = corner[BLOCK + n]
            c = corner[2 * BLOCK + n]
            u = part[n]
            v = part[BLOCK + n]
            w = part[2 * BLOCK + n]
            o = to + (n * scales + scale) * channels
            # The number of channels at a time is a constant of the compiled code.
            if channels % WIDE == 0:
                for s in range(0, channels, WIDE):
                    product_forward(
                        table, out, a + s, b + s, c + s, o + s, channels, size * channels, u, v, w, WIDE
                    )
            else:
                for s in range(0, channels, NARROW):
                    product_forward(
                        table, out, a + s, b + s, c + s, o + s, channels, size * channels, u, v, w, NARROW
                    )


@_jit
def forward(points, table, channels, sizes, starts, out):
    """out[n, scale, c] = product over the planes of the bilinear sample at point n."""
    total = len(points) // 3
    for task in numba.prange((total + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        corner = np.empty(3 * BLOCK, np.int64)
        part = np.empty(3 * BLOCK, np.float32)
        count = min(BLOCK, total - first)
        # In a function of its own: with these loops here the compiled ones are a tenth slower.
        _features(
            points,
            first,
            count,
            table,
            channels,
            sizes,
            starts,
            corner,
            part,
            out,
            first * len(sizes) * channels,
        )


@traced
def dot(x, at, weight, count):
    """The sum of x[at :] times weight over `count` numbers, whole vectors."""

    def step(k, sums):
        return [sums[0] + load(x, at + k, NARROW) * load(weight, k, NARROW)]

    (found,) = repeat(count, [splat(x, 0.0, NARROW)], step, by=NARROW)
    return total(found)


@_jit
def weighed(points, table, sizes, starts, weight, out, density):
    """`forward`, and density[n] = exp(min(out[n] . weight - 1, limit)); the limit stands behind the weights."""
    count = len(points) // 3
    width = len(weight) - 1
    channels = width // len(sizes)
    limit = weight[width]
    for task in numba.prange((count + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        corner = np.empty(3 * BLOCK, np.int64)
        part = np.empty(3 * BLOCK, np.float32)
        rows = min(BLOCK, count - first)
        raw = np.zeros(BLOCK, np.float32)
        to = first * width
        _features(points, first, rows, table, channels, sizes, starts, corner, part, out, to)
        for n in range(rows):
            raw[n] = dot(out, to + n * width, weight, width)
        exponential(raw, 0, limit, BLOCK)
        density[first : first + rows] = raw[:rows]


@_jit
def backward(points, table, channels, sizes, starts, grad, slices, out):
    """Add the table's gradient to `out` [slices ...]; a task per slice of the points, scale, channel
    group.
    """
    scales = len(sizes)
    total = len(points) // 3
    groups = (channels + GROUP - 1) // GROUP
    blocks = (len(points) // 3 + BLOCK - 1) // BLOCK
    for task in numba.prange(slices * scales * groups):
        part_of = task % slices
        rest = task // slices
        scale = scales - 1 - rest // groups
        here = rest % groups * GROUP
        wide = min(here + GROUP, channels) - here
        size = sizes[scale]
        mine = part_of * len(table)
        corner = np.empty(3 * BLOCK, np.int64)
        part = np.empty(3 * BLOCK, np.float32)
        for block in range(part_of * blocks // slices, (part_of + 1) * blocks // slices):
            first = block * BLOCK
            count = min(BLOCK, total - first)
            cells(points, first, count, size, starts[scale], channels, corner, part)
            o = (first * scales + scale) * channels + here
            apart = scales * channels
            for n in range(count):
                a = corner[n] + here
                b = corner[BLOCK + n] + here
                c = corner[2 * BLOCK + n] + here
                u = part[n]
                v = part[BLOCK + n]
                w = part[2 * BLOCK + n]
                if wide % WIDE == 0:
                    for s in range(0, wide, WIDE):
                        at = o + n * apart + s
                        product_backward(
                            table,
                            grad,
                            out,
                            a + s,
                            b + s,
                            c + s,
                            at,
                            mine,
                            channels,
                            size * channels,
                            u,
                            v,
                            w,
                            WIDE,
                        )
                else:
                    for s in range(0, wide, NARROW):
                        at = o + n * apart + s
                        product_backward(
                            table,
                            grad,
                            out,
                            a + s,
                            b + s,
                            c + s,
                            at,
                            mine,
                            channels,
                            size * channels,
                            u,
                            v,
                            w,
                            NARROW,
                        )


@_jit
def point_slopes(points, table, channels, sizes, starts, grad, out):
    """out [N 3] = gradient of the points, for the features' gradient grad [N scales*channels].

    Along an axis on which a point lies outside of the planes, or nowhere, it is 0: there the border's value
    holds.
    """
    scales = len(sizes)
    total = len(points) // 3
    for task in numba.prange((total + BLOCK - 1) // BLOCK):
        first = task * BLOCK
        corner = np.empty(3 * BLOCK, np.int64)
        part = np.empty(3 * BLOCK, np.float32)
        sums = np.empty(3 * NARROW, np.float32)
        count = min(BLOCK, total - first)
        out[3 * first : 3 * (first + count)] = np.float32(0)
        for scale in range(scales):
            size = sizes[scale]
            half = np.float32(0.5) * np.float32(size - 1)
            last = np.float32(size - 1)
            cells(points, first, count, size, starts[scale], channels, corner, part)
            o = (first * scales + scale) * channels
            apart = scales * channels
            for n in range(count):
                a = corner[n]
                b = corner[BLOCK + n]
                c = corner[2 * BLOCK + n]
                u = part[n]
                v = part[BLOCK + n]
                w = part[2 * BLOCK + n]
                sums[:] = np.float32(0)
                for s in range(0, channels, NARROW):
                    product_slopes(
                        table,
                        grad,
                        sums,
                        a + s,
                        b + s,
                        c + s,
                        o + n * apart + s,
                        channels,
                        size * channels,
                        u,
                        v,
                        w,
                    )
                for axis in range(3):
                    at = (points[3 * (first + n) + axis] + np.float32(1)) * half
                    if at >= np.float32(0) and at <= last:
                        slope = np.float32(0)
                        for lane in range(NARROW):
                            slope += sums[axis * NARROW + lane]
                        out[3 * (first + n) + axis] += half * slope


@traced
def difference(table, at, step, count):
    """The sum of the squares of table[at + step :] - table[at :] over `count` numbers, whole vectors."""

    def add(k, sums):
        apart = load(table, at + step + k, NARROW) - load(table, at + k, NARROW)
        return [sums[0] + apart * apart]

    (found,) = repeat(count, [splat(table, 0.0, NARROW)], add, by=NARROW)
    return total(found)


@numba.njit(inline="always")
def _differences(table, first, step, count):
    """`difference` of any length, its pieces added in float64."""
    line = 0.0
    for at in range(0, count, _PIECE):
        line += difference(table, first + at, step, min(_PIECE, count - at))
    return line


@_jit
def variation(table, channels, sizes, starts):
    """Sum over scales of the mean squared difference of neighbours across, and down."""
    whole = 0.0
    for scale in range(len(sizes)):
        size = sizes[scale]
        width = size * channels
        part = 0.0
        for row in numba.prange(3 * size):
            first = (starts[scale] + row * size) * channels
            line = _differences(table, first, channels, width - channels)
            if row % size < size - 1:
                line += _differences(table, first, width, width)
            part += line
        whole += part / (3.0 * size * (size - 1) * channels)
    return whole


@traced
def apart_from_neighbours(table, at, offsets, factor, out, count):
    """out[at :] += factor (4 table[at :] - those at four offsets, west, east, north, south) for `count` numbers,
    whole vectors.
    """
    west, east, north, south = offsets

    def step(k, held):
        x = at + k
        beside = load(table, x - west, NARROW) + load(table, x + east, NARROW)
        above = load(table, x - north, NARROW) + load(table, x + south, NARROW)
        apart = 4.0 * load(table, x, NARROW) - (beside + above)
        store(out, x, load(out, x, NARROW) + narrow(factor, NARROW) * apart)
        return held

    repeat(count, [splat(table, 0.0, NARROW)], step, by=NARROW)


@_jit
def variation_gradient(table, channels, sizes, starts, scale, out):
    """out += scale * d variation / d table: twice the differences to the four neighbours; a missing one is
    itself.
    """
    for s in range(len(sizes)):
        size = sizes[s]
        factor = np.float32(2.0 * scale / (3.0 * size * (size - 1) * channels))
        width = size * channels
        for row in numba.prange(3 * size):
            v = row % size
            first = (starts[s] + row * size) * channels
            last = first + width - channels
            north = width if v > 0 else 0
            south = width if v < size - 1 else 0
            inner = first + channels
            none = 0 * channels
            begin = (none, channels, north, south)
            apart_from_neighbours(table, first, begin, factor, out, channels)
            within = (channels, channels, north, south)
            apart_from_neighbours(table, inner, within, factor, out, last - inner)
            end = (channels, none, north, south)
            apart_from_neighbours(table, last, end, factor, out, channels)
