"""Compiled backward pass of the rasteriser of 3D Gaussians; blocks, splats and entries are those of `rasterise_kernels`.

Of every entry SUMS floats are kept: the sums over its pixels of p, p dx, p dx^2, p dy, p dx dy, p dy^2, where p is
dL / d ln alpha, then of weight times the gradient of each channel. Slots of one Gaussian lie together, so its sums have one
order on any number of threads.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

import math

import numba
import numpy as np

from .rasterise_kernels import (
    BLUR,
    FIXED,
    MAX_ALPHA,
    MIN_ALPHA,
    ROWS,
    SLOTS,
    STOP,
    axes,
    basis,
    colour,
    footprint,
    jit,
    opacity,
    serial,
)
from .simd import (
    LANES,
    add_scaled,
    dot,
    exp2_rough,
    lanes,
    largest,
    load,
    loads,
    maximum,
    minimum,
    splat,
    splats,
    square_root,
    store,
    stores,
    sums,
    where_greater,
    zeros,
)

__all__ = ["SUMS", "adam", "composite_back", "gradients", "lift", "lift_values"]

SUMS = LANES
GEOMETRY = 6
"""Sums of an entry that are about its shape; those of channels follow."""

_f = np.float32
_0, _1, _2, _3, _4, _HALF = _f(0), _f(1), _f(2), _f(3), _f(4), _f(0.5)
_BLUR, _STOP, _MAX = _f(BLUR), _f(STOP), _f(MAX_ALPHA)
_LOG_MIN, _LOG_MAX = _f(math.log2(MIN_ALPHA)), _f(math.log2(MAX_ALPHA))
_HUGE, _TENTH = _f(1e16), _f(0.1)
_PARTS = 64


def _composite_back(channels, geometry):
    @jit
    def composite_back(start, ids, slots, rows, splats_in, values, stride, offset, width, height, out, left, grad, grad_left):
        """SUMS of each slot, from the planes of `composite` and their gradients, both padded to whole tiles."""
        across, down = (width + LANES - 1) // LANES, (height + ROWS - 1) // ROWS
        padded, area, tile_area = across * LANES, across * LANES * down * ROWS, ROWS * LANES
        found = np.empty((len(ids) + 1) * SUMS, np.float32)
        for tile in numba.prange(across * down):
            bx, by = tile % across * LANES, tile // across * ROWS
            passing, rest = np.ones(tile_area, np.float32), np.empty(tile_area, np.float32)
            slope = np.empty(channels * tile_area, np.float32)
            for y in range(ROWS):
                d = (by + y) * padded + bx
                g = loads(grad, d, area, channels)
                stores(slope, y * LANES, tile_area, g)
                if geometry:  # what is behind everything so far, in the direction of the gradient
                    store(rest, y * LANES, dot(g, loads(out, d, area, channels)) + load(grad_left, d) * load(left, d))
            low, high = 0, min(ROWS, height - by)
            k, end = start[tile], start[tile + 1]
            xs = lanes() + (_f(bx) + _HALF)
            while k < end and low < high:
                stop = min(k + 16, end)
                for q in range(k, stop):
                    o = ids[q] * SLOTS
                    first, last = max(rows[q] & 255, low), min(rows[q] >> 8, high)
                    dx, my = xs - splats_in[o], splats_in[o + 1] - _HALF - _f(by)
                    p0, p1, p2 = splats_in[o + 2] * dx * dx + splats_in[o + 5], splats_in[o + 3] * dx, splats_in[o + 4]
                    value = splats(values, ids[q] * stride + offset, channels)
                    summed = zeros(channels)
                    a0, a1, a2 = splat(_0), splat(_0), splat(_0)
                    for y in range(first, last):
                        dy = _f(y) - my
                        power = p0 + dy * (p1 + p2 * dy)
                        alpha = where_greater(power, _LOG_MIN, minimum(exp2_rough(power), _MAX), _0)
                        d = y * LANES
                        t = load(passing, d)
                        weight = alpha * t
                        store(passing, d, t - weight)
                        g = loads(slope, d, tile_area, channels)
                        summed = add_scaled(summed, weight, g)
                        if geometry:
                            gain = weight * dot(value, g)
                            behind = load(rest, d) - gain
                            store(rest, d, behind)
                            p = gain - behind * (alpha / (_1 - alpha))
                            p = where_greater(_LOG_MAX, power, p, _0)  # a cut alpha does not move
                            a0, a1, a2 = a0 + p, a1 + p * dy, a2 + p * (dy * dy)
                    shape = (a0, a0 * dx, a0 * dx * dx, a1, a1 * dx, a2)
                    store(found, slots[q] * SUMS, sums(shape + summed))
                k = stop
                while low < high and largest(load(passing, low * LANES)) < _STOP:
                    low += 1
                while low < high and largest(load(passing, (high - 1) * LANES)) < _STOP:
                    high -= 1
            for q in range(k, end):
                store(found, slots[q] * SUMS, splat(_0))
        return found

    return composite_back


composite_back = {channels: _composite_back(channels, True) for channels in (3, 4, 8)}
"""SUMS of so many channels at once."""
lift = {8: _composite_back(8, False)}
"""The same without the shape's sums, which are 0."""


@jit
def lift_values(found, first_slot, count, out, stride, offset, channels):
    """out[stride * i + offset ...] = the sums of the channels of each Gaussian."""
    for i in numba.prange(count):
        to = i * stride + offset
        out[to : to + channels] = _0
        for slot in range(first_slot[i], first_slot[i + 1]):
            for c in range(channels):
                out[to + c] += found[slot * SUMS + GEOMETRY + c]


@serial
def _block_sums(found, first_slot, first, channels, tmp):
    """The sums of LANES Gaussians in rows of tmp."""
    one = np.empty(GEOMETRY + 4, np.float32)
    for lane in range(LANES):
        one[:] = _0
        for slot in range(first_slot[first + lane], first_slot[first + lane + 1]):
            for c in range(GEOMETRY + channels):
                one[c] += found[slot * SUMS + c]
        for c in range(GEOMETRY + 4):
            tmp[c * LANES + lane] = one[c]


@serial
def _direction_slopes(x, y, z, bands, blocks, at, red, green, blue):
    """The gradient of the colour in a unit direction, from that of its channels; components along the direction are left in."""
    gx, gy, gz = splat(_0), splat(_0), splat(_0)
    c1 = _f(0.4886025119029199)
    for k in range(1, bands):
        o = at + (FIXED + 3 * k) * LANES
        s = red * load(blocks, o) + green * load(blocks, o + LANES) + blue * load(blocks, o + 2 * LANES)
        if k == 1:
            gy = gy - c1 * s
        elif k == 2:
            gz = gz + c1 * s
        elif k == 3:
            gx = gx - c1 * s
        elif k == 4:
            s = s * _f(1.0925484305920792)
            gx, gy = gx + s * y, gy + s * x
        elif k == 5:
            s = s * _f(-1.0925484305920792)
            gy, gz = gy + s * z, gz + s * y
        elif k == 6:
            s = s * _f(0.31539156525252005)
            gx, gy, gz = gx - _2 * s * x, gy - _2 * s * y, gz + _4 * s * z
        elif k == 7:
            s = s * _f(-1.0925484305920792)
            gx, gz = gx + s * z, gz + s * x
        elif k == 8:
            s = s * _f(0.5462742152960396)
            gx, gy = gx + _2 * s * x, gy - _2 * s * y
        elif k == 9:
            s = s * _f(-0.5900435899266435)
            gx, gy = gx + s * _f(6) * x * y, gy + s * _3 * (x * x - y * y)
        elif k == 10:
            s = s * _f(2.890611442640554)
            gx, gy, gz = gx + s * y * z, gy + s * x * z, gz + s * x * y
        elif k == 11:
            s = s * _f(-0.4570457994644658)
            gx, gy, gz = gx - _2 * s * x * y, gy + s * (_4 * z * z - x * x - _3 * y * y), gz + _f(8) * s * y * z
        elif k == 12:
            s = s * _f(0.3731763325901154)
            gx, gy, gz = gx - _f(6) * s * x * z, gy - _f(6) * s * y * z, gz + s * (_f(6) * z * z - _3 * (x * x + y * y))
        elif k == 13:
            s = s * _f(-0.4570457994644658)
            gx, gy, gz = gx + s * (_4 * z * z - _3 * x * x - y * y), gy - _2 * s * x * y, gz + _f(8) * s * x * z
        elif k == 14:
            s = s * _f(1.445305721320277)
            gx, gy, gz = gx + _2 * s * x * z, gy - _2 * s * y * z, gz + s * (x * x - y * y)
        else:
            s = s * _f(-0.5900435899266435)
            gx, gy = gx + s * _3 * (x * x - y * y), gy - s * _f(6) * x * y
    return gx, gy, gz


@serial
def _block_gradient(blocks, at, bands, view, tmp, out, to):
    """Rows of out from `to` on: the gradient of the parameters of a block, from sums in tmp: shape (6), colour, depth.

    Sigma' = -Sigma^-1 G Sigma^-1 turns the shape's sums into those of the covariance; then back through `footprint` and `axes`.
    """
    mean, centre, scales, (qw, qx, qy, qz, q_inverse), world, camera = axes(blocks, at, view)
    (u, v, near_u, near_v, inverse, fx, fy), (j00, j01, j02, j10, j11, j12), (xx0, yy0, xy, det0) = footprint(
        centre, camera, view
    )
    xx, yy = xx0 + _BLUR, yy0 + _BLUR
    det = det0 + _BLUR * (xx0 + yy0) + _BLUR * _BLUR
    invert = _1 / det
    s0, sx, sxx, sy, sxy, syy, red, green, blue, depth = loads(tmp, 0, LANES, 10)
    # What is not drawn has sums of 0, but may have infinite factors.
    drawn = where_greater(centre[2], view[23], where_greater(_HUGE, xx + yy, splat(_1), _0), _0)

    # Image position and covariance.
    ca, cb, cc = yy * invert, -xy * invert, xx * invert
    g_px, g_py = ca * sx + cb * sy, cb * sx + cc * sy
    e00, e01, e10, e11 = ca * sxx + cb * sxy, ca * sxy + cb * syy, cb * sxx + cc * sxy, cb * sxy + cc * syy
    g_xx, g_yy, g_xy = _HALF * (e00 * ca + e01 * cb), _HALF * (e10 * cb + e11 * cc), e00 * cb + e01 * cc
    if view[24] > 0:  # alpha falls with the square root of det0 / det
        ratio = det0 * invert
        k = _HALF * s0 / (ratio + _f(1e-8)) * invert
        g_xx, g_yy = g_xx + k * (yy0 - ratio * yy), g_yy + k * (xx0 - ratio * xx)
        g_xy = g_xy - _2 * k * xy * (_1 - ratio)

    # Axes in pixels, then in camera and world coordinates.
    h00, h01, h02 = _2 * g_xx * j00 + g_xy * j10, _2 * g_xx * j01 + g_xy * j11, _2 * g_xx * j02 + g_xy * j12
    h10, h11, h12 = _2 * g_yy * j10 + g_xy * j00, _2 * g_yy * j11 + g_xy * j01, _2 * g_yy * j12 + g_xy * j02
    g_z = depth - inverse * (j00 * h00 + j01 * h01 + j02 * h02 + j10 * h10 + j11 * h11 + j12 * h12)
    h00, h01, h02, h10, h11, h12 = h00 * fx, h01 * fx, h02 * fx, h10 * fy, h11 * fy, h12 * fy
    inside_u = where_greater(u, view[19], where_greater(view[20], u, splat(_1), _0), _0)
    inside_v = where_greater(v, view[21], where_greater(view[22], v, splat(_1), _0), _0)
    g_u = view[12] * g_px - inside_u * (camera[6] * h00 + camera[7] * h01 + camera[8] * h02)
    g_v = view[13] * g_py - inside_v * (camera[6] * h10 + camera[7] * h11 + camera[8] * h12)
    g_x, g_y = g_u * inverse, g_v * inverse
    g_z = g_z - (u * g_u + v * g_v) * inverse
    b0, b1, b2 = -(near_u * h00 + near_v * h10), -(near_u * h01 + near_v * h11), -(near_u * h02 + near_v * h12)
    n00, n01, n02 = (
        view[0] * h00 + view[3] * h10 + view[6] * b0, view[0] * h01 + view[3] * h11 + view[6] * b1,
        view[0] * h02 + view[3] * h12 + view[6] * b2,
    )  # fmt: skip
    n10, n11, n12 = (
        view[1] * h00 + view[4] * h10 + view[7] * b0, view[1] * h01 + view[4] * h11 + view[7] * b1,
        view[1] * h02 + view[4] * h12 + view[7] * b2,
    )  # fmt: skip
    n20, n21, n22 = (
        view[2] * h00 + view[5] * h10 + view[8] * b0, view[2] * h01 + view[5] * h11 + view[8] * b1,
        view[2] * h02 + view[5] * h12 + view[8] * b2,
    )  # fmt: skip
    stores(out, to + 3 * LANES, LANES, (
        drawn_or_0(drawn, n00 * world[0] + n10 * world[3] + n20 * world[6]),
        drawn_or_0(drawn, n01 * world[1] + n11 * world[4] + n21 * world[7]),
        drawn_or_0(drawn, n02 * world[2] + n12 * world[5] + n22 * world[8]),
    ))  # fmt: skip

    # Quaternion: of the unit one, then across it.
    n00, n10, n20 = n00 * scales[0], n10 * scales[0], n20 * scales[0]
    n01, n11, n21 = n01 * scales[1], n11 * scales[1], n21 * scales[1]
    n02, n12, n22 = n02 * scales[2], n12 * scales[2], n22 * scales[2]
    kw = _2 * (qx * (n21 - n12) + qy * (n02 - n20) + qz * (n10 - n01))
    kx = _2 * (qy * (n01 + n10) + qz * (n02 + n20) + qw * (n21 - n12) - _2 * qx * (n11 + n22))
    ky = _2 * (qx * (n01 + n10) + qz * (n12 + n21) + qw * (n02 - n20) - _2 * qy * (n00 + n22))
    kz = _2 * (qx * (n02 + n20) + qy * (n12 + n21) + qw * (n10 - n01) - _2 * qz * (n00 + n11))
    along = kw * qw + kx * qx + ky * qy + kz * qz
    alpha = opacity(load(blocks, at + 10 * LANES))
    stores(out, to + 6 * LANES, LANES, (
        drawn_or_0(drawn, (kw - qw * along) * q_inverse), drawn_or_0(drawn, (kx - qx * along) * q_inverse),
        drawn_or_0(drawn, (ky - qy * along) * q_inverse), drawn_or_0(drawn, (kz - qz * along) * q_inverse),
        s0 * (_1 - alpha),
    ))  # fmt: skip

    # Colour: no gradient where it is cut at 0.
    dx, dy, dz = mean[0] - view[16], mean[1] - view[17], mean[2] - view[18]
    shrink = _1 / square_root(maximum(dx * dx + dy * dy + dz * dz, _f(1e-24)))
    dx, dy, dz = dx * shrink, dy * shrink, dz * shrink
    values = tmp[10 * LANES :]
    basis(dx, dy, dz, bands, values)
    was_red, was_green, was_blue = colour(blocks, at, bands, values)
    red, green, blue = (
        where_greater(was_red, _0, red, _0),
        where_greater(was_green, _0, green, _0),
        where_greater(was_blue, _0, blue, _0),
    )
    for k in range(bands):
        b = load(values, k * LANES)
        stores(out, to + (FIXED + 3 * k) * LANES, LANES, (b * red, b * green, b * blue))
    gx, gy, gz = _direction_slopes(dx, dy, dz, bands, blocks, at, red, green, blue)
    along = gx * dx + gy * dy + gz * dz
    stores(out, to, LANES, (
        drawn_or_0(drawn, view[0] * g_x + view[3] * g_y + view[6] * g_z + (gx - dx * along) * shrink),
        drawn_or_0(drawn, view[1] * g_x + view[4] * g_y + view[7] * g_z + (gy - dy * along) * shrink),
        drawn_or_0(drawn, view[2] * g_x + view[5] * g_y + view[8] * g_z + (gz - dz * along) * shrink),
    ))  # fmt: skip


@serial
def drawn_or_0(drawn, value):
    """The value where something is drawn, else 0, whatever the value is."""
    return where_greater(drawn, _0, value, _0)


@jit
def gradients(blocks, count, bands, view, found, first_slot, channels, out):
    """The gradients of `count` Gaussians, in blocks; channels: 3 (colour) or 4 (and depth)."""
    rows = (FIXED + 3 * bands) * LANES
    for part in numba.prange((count + _PARTS * LANES - 1) // (_PARTS * LANES)):
        tmp = np.empty(26 * LANES, np.float32)
        for first in range(part * _PARTS * LANES, min(count, (part + 1) * _PARTS * LANES), LANES):
            at = first // LANES * rows
            if first_slot[first + LANES] == first_slot[first]:
                out[at : at + rows] = _0
                continue
            _block_sums(found, first_slot, first, channels, tmp)
            _block_gradient(blocks, at, bands, view, tmp, out, at)


@jit
def adam(blocks, first, second, count, bands, view, found, first_slot, rates, grown, beta2):
    """One step of Adam, in place, for the blocks that have an entry; the others keep their moments as well.

    rates: a learning rate for each row of a block; grown: what the two moments are multiplied by, 1 / (1 - beta^step).
    """
    rows = FIXED + 3 * bands
    for part in numba.prange((count + _PARTS * LANES - 1) // (_PARTS * LANES)):
        tmp = np.empty(26 * LANES, np.float32)
        slopes = np.empty(rows * LANES, np.float32)
        for start in range(part * _PARTS * LANES, min(count, (part + 1) * _PARTS * LANES), LANES):
            if first_slot[start + LANES] == first_slot[start]:
                continue
            at = start * rows
            _block_sums(found, first_slot, start, 3, tmp)
            _block_gradient(blocks, at, bands, view, tmp, slopes, 0)
            for row in range(rows):
                o = at + row * LANES
                g = load(slopes, row * LANES)
                m, s = load(first, o), load(second, o)
                m = m + _TENTH * (g - m)
                s = s + (_1 - beta2) * (g * g - s)
                store(first, o, m)
                store(second, o, s)
                moved = rates[row] * grown[0] * m / (square_root(s * grown[1]) + _f(1e-15))
                store(blocks, o, load(blocks, o) - moved)
