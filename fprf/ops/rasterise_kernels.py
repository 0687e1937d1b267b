"""Compiled forward pass of the rasteriser of 3D Gaussians: projection, tiles, compositing. `rasterise` is their bridge.

Blocks: parameters of LANES Gaussians lie together, one row of LANES numbers each: mean 0-2, ln scale 3-5, quaternion wxyz 6-9,
logit of the opacity 10, then harmonics [K 3]. A flat array of blocks, so that every load is one vector.

Splats: SLOTS floats a Gaussian after projection: x y, A B C D with log2 alpha = A dx^2 + B dx dy + C dy^2 + D, red green blue,
depth, half width and half height of the ellipse where alpha is 1/255, then what cuts it into rows: xy/xx, det/xx, 1/xx, and dx
of its top. A half width of no more than 0 says why there is nothing to draw: FAINT, BEHIND, OUTSIDE, INVALID.

Entries: a Gaussian in a tile, LANES pixels wide and ROWS high, with the rows that it may reach: first + 256 * (last + 1).
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

import math

import numba
import numpy as np

from .simd import (
    LANES,
    add_scaled,
    exp2,
    exp2_rough,
    lanes,
    largest,
    load,
    loads,
    log2,
    maximum,
    minimum,
    splat,
    splats,
    square_root,
    store,
    stores,
    where_greater,
)

__all__ = ["BLUR", "FIXED", "MAX_ALPHA", "MIN_ALPHA", "ROWS", "SLOTS", "STOP", "bins", "composite", "pack", "project"]

FIXED, SLOTS, ROWS = 11, 16, 16
BLUR = 0.3
"""Variance in pixels that every projected Gaussian gets: the footprint of a pixel."""
MIN_ALPHA, MAX_ALPHA = 1 / 255, 0.99
STOP = 1e-3
"""Rows of a tile through which no more than this share of light passes are left alone."""
FAINT, BEHIND, OUTSIDE, INVALID = 0, 1, 2, 3

FAST = {"contract", "arcp", "nsz"}
jit = numba.njit(parallel=True, cache=True, nogil=True, fastmath=FAST)
serial = numba.njit(cache=True, nogil=True, fastmath=FAST)

_f = np.float32
_0, _1, _2, _3, _4, _HALF = _f(0), _f(1), _f(2), _f(3), _f(4), _f(0.5)
_BLUR, _STOP = _f(BLUR), _f(STOP)
_MAX = _f(MAX_ALPHA)
_LOG2E, _LN2 = _f(1 / math.log(2)), _f(math.log(2))
_LOG_MIN = _f(math.log2(MIN_ALPHA))
_PARTS = 64
"""Blocks of a task."""
_HUGE, _LARGE, _MOST_LOG, _MARK = _f(1e16), _f(1e15), _f(30), _f(-70)
"""Square pixels and coordinates beyond which a Gaussian is invalid; most of a logarithm; the logit of the invalid."""


@jit
def pack(means, quaternions, log_scales, logits, harmonics, blocks):
    """Put arrays [N 3], [N 4], [N 3], [N], [N K 3] into blocks. Scales and opacities are limited to what float32 can square; a
    Gaussian with NaN, or with another number beyond 1e15, is marked as invalid by its logit."""
    count, bands = harmonics.shape[0], harmonics.shape[1]
    for block in numba.prange((count + LANES - 1) // LANES):
        at = block * (FIXED + 3 * bands) * LANES
        blocks[at : at + (FIXED + 3 * bands) * LANES] = _0
        for lane in range(LANES):
            i, o = block * LANES + lane, at + lane
            blocks[o + 10 * LANES] = _MARK
            if i >= count:
                continue
            fine = logits[i] == logits[i]
            for c in range(3):
                fine = fine and abs(means[i, c]) < _LARGE and log_scales[i, c] == log_scales[i, c]
                for k in range(bands):
                    fine = fine and abs(harmonics[i, k, c]) < _LARGE
            for c in range(4):
                fine = fine and abs(quaternions[i, c]) < _LARGE
            if not fine:
                continue
            for c in range(3):
                blocks[o + c * LANES] = means[i, c]
                blocks[o + (3 + c) * LANES] = min(max(log_scales[i, c], -_MOST_LOG), _MOST_LOG)
            for c in range(4):
                blocks[o + (6 + c) * LANES] = quaternions[i, c]
            blocks[o + 10 * LANES] = min(max(logits[i], -_MOST_LOG), _MOST_LOG)
            for k in range(bands):
                for c in range(3):
                    blocks[o + (FIXED + 3 * k + c) * LANES] = harmonics[i, k, c]


@serial
def basis(x, y, z, bands, out):
    """The first `bands` of the 16 real spherical harmonics at unit vectors, to out[LANES k]."""
    store(out, 0, splat(_f(0.28209479177387814)))
    if bands > 1:
        store(out, LANES, _f(-0.4886025119029199) * y)
        store(out, 2 * LANES, _f(0.4886025119029199) * z)
        store(out, 3 * LANES, _f(-0.4886025119029199) * x)
    if bands > 4:
        store(out, 4 * LANES, _f(1.0925484305920792) * x * y)
        store(out, 5 * LANES, _f(-1.0925484305920792) * y * z)
        store(out, 6 * LANES, _f(0.31539156525252005) * (_2 * z * z - x * x - y * y))
        store(out, 7 * LANES, _f(-1.0925484305920792) * x * z)
        store(out, 8 * LANES, _f(0.5462742152960396) * (x * x - y * y))
    if bands > 9:
        store(out, 9 * LANES, _f(-0.5900435899266435) * y * (_3 * x * x - y * y))
        store(out, 10 * LANES, _f(2.890611442640554) * x * y * z)
        store(out, 11 * LANES, _f(-0.4570457994644658) * y * (_4 * z * z - x * x - y * y))
        store(out, 12 * LANES, _f(0.3731763325901154) * z * (_2 * z * z - _3 * (x * x + y * y)))
        store(out, 13 * LANES, _f(-0.4570457994644658) * x * (_4 * z * z - x * x - y * y))
        store(out, 14 * LANES, _f(1.445305721320277) * z * (x * x - y * y))
        store(out, 15 * LANES, _f(-0.5900435899266435) * x * (x * x - _3 * y * y))


@serial
def colour(blocks, at, bands, tmp):
    """0.5 + harmonics times the basis in tmp: three vectors, before they are cut at 0."""
    red, green, blue = splat(_HALF), splat(_HALF), splat(_HALF)
    for k in range(bands):
        b, o = load(tmp, k * LANES), at + (FIXED + 3 * k) * LANES
        red = red + b * load(blocks, o)
        green = green + b * load(blocks, o + LANES)
        blue = blue + b * load(blocks, o + 2 * LANES)
    return red, green, blue


@serial
def rotation(w, x, y, z):
    """The rows of the rotation of a quaternion and 1 / |q|; a quaternion of zeros is no rotation."""
    shrink = _1 / square_root(maximum(w * w + x * x + y * y + z * z, _f(1e-24)))
    w, x, y, z = w * shrink, x * shrink, y * shrink, z * shrink
    return (
        _1 - _2 * (y * y + z * z), _2 * (x * y - w * z), _2 * (x * z + w * y),
        _2 * (x * y + w * z), _1 - _2 * (x * x + z * z), _2 * (y * z - w * x),
        _2 * (x * z - w * y), _2 * (y * z + w * x), _1 - _2 * (x * x + y * y),
        w, x, y, z, shrink,
    )  # fmt: skip


@serial
def axes(blocks, at, view):
    """Camera coordinates of the means, and the scaled axes of the Gaussians in world and in camera coordinates."""
    x, y, z = load(blocks, at), load(blocks, at + LANES), load(blocks, at + 2 * LANES)
    cx = view[0] * x + view[1] * y + view[2] * z + view[9]
    cy = view[3] * x + view[4] * y + view[5] * z + view[10]
    cz = view[6] * x + view[7] * y + view[8] * z + view[11]
    turn = rotation(*loads(blocks, at + 6 * LANES, LANES, 4))
    s0, s1, s2 = (
        exp2(load(blocks, at + 3 * LANES) * _LOG2E),
        exp2(load(blocks, at + 4 * LANES) * _LOG2E),
        exp2(load(blocks, at + 5 * LANES) * _LOG2E),
    )
    m00, m01, m02 = turn[0] * s0, turn[1] * s1, turn[2] * s2
    m10, m11, m12 = turn[3] * s0, turn[4] * s1, turn[5] * s2
    m20, m21, m22 = turn[6] * s0, turn[7] * s1, turn[8] * s2
    world = (m00, m01, m02, m10, m11, m12, m20, m21, m22)
    camera = (
        view[0] * m00 + view[1] * m10 + view[2] * m20, view[0] * m01 + view[1] * m11 + view[2] * m21,
        view[0] * m02 + view[1] * m12 + view[2] * m22,
        view[3] * m00 + view[4] * m10 + view[5] * m20, view[3] * m01 + view[4] * m11 + view[5] * m21,
        view[3] * m02 + view[4] * m12 + view[5] * m22,
        view[6] * m00 + view[7] * m10 + view[8] * m20, view[6] * m01 + view[7] * m11 + view[8] * m21,
        view[6] * m02 + view[7] * m12 + view[8] * m22,
    )  # fmt: skip
    return (x, y, z), (cx, cy, cz), (s0, s1, s2), turn[9:], world, camera


@serial
def footprint(centre, camera, view):
    """The image position u, v (tangents), the axes in pixels j, their covariance xx, yy, xy and its determinant, blur apart.

    The determinant is the squared length of a cross product: xx yy - xy^2 would lose the digits of thin ellipses.
    """
    cx, cy, cz = centre
    inverse = _1 / where_greater(cz, view[23], cz, _1)
    u, v = cx * inverse, cy * inverse
    near_u, near_v = minimum(maximum(u, view[19]), view[20]), minimum(maximum(v, view[21]), view[22])
    fx, fy = view[12] * inverse, view[13] * inverse
    j00, j01, j02 = (
        fx * (camera[0] - near_u * camera[6]),
        fx * (camera[1] - near_u * camera[7]),
        fx * (camera[2] - near_u * camera[8]),
    )
    j10, j11, j12 = (
        fy * (camera[3] - near_v * camera[6]),
        fy * (camera[4] - near_v * camera[7]),
        fy * (camera[5] - near_v * camera[8]),
    )
    xx, yy, xy = j00 * j00 + j01 * j01 + j02 * j02, j10 * j10 + j11 * j11 + j12 * j12, j00 * j10 + j01 * j11 + j02 * j12
    c0, c1, c2 = j01 * j12 - j02 * j11, j02 * j10 - j00 * j12, j00 * j11 - j01 * j10
    return (u, v, near_u, near_v, inverse, fx, fy), (j00, j01, j02, j10, j11, j12), (xx, yy, xy, c0 * c0 + c1 * c1 + c2 * c2)


@serial
def opacity(logit):
    """Sigmoid."""
    return _1 / (_1 + exp2(logit * -_LOG2E))


@jit
def project(blocks, count, bands, view, width, height, splats_out):
    """Fill SLOTS floats for each of `count` Gaussians."""
    rows = (FIXED + 3 * bands) * LANES
    for part in numba.prange((count + _PARTS * LANES - 1) // (_PARTS * LANES)):
        tmp = np.empty(SLOTS * LANES, np.float32)
        for first in range(part * _PARTS * LANES, min(count, (part + 1) * _PARTS * LANES), LANES):
            at = first // LANES * rows
            mean, centre, _, _, _, camera = axes(blocks, at, view)
            (u, v, _, _, _, _, _), _, (xx0, yy0, xy, det0) = footprint(centre, camera, view)
            xx, yy = xx0 + _BLUR, yy0 + _BLUR
            det = det0 + _BLUR * (xx0 + yy0) + _BLUR * _BLUR
            invert = _1 / det
            alpha = opacity(load(blocks, at + 10 * LANES))
            if view[24] > 0:
                alpha = alpha * square_root(det0 * invert + _f(1e-8))
            highest = log2(alpha)
            # Where log2 alpha falls below that of MIN_ALPHA: (dx, dy) Sigma^-1 (dx, dy) = reach.
            reach = (highest - _LOG_MIN) * (_2 * _LN2)
            half_width, half_height = square_root(maximum(reach, _0) * xx), square_root(maximum(reach, _0) * yy)
            px, py = view[12] * u + view[14], view[13] * v + view[15]
            shown = where_greater(
                px + half_width, _0, where_greater(_f(width), px - half_width, half_width, _f(-OUTSIDE)), _f(-OUTSIDE)
            )
            shown = where_greater(
                py + half_height, _0, where_greater(_f(height), py - half_height, shown, _f(-OUTSIDE)), _f(-OUTSIDE)
            )
            shown = where_greater(centre[2], view[23], shown, _f(-BEHIND))
            shown = where_greater(reach, _0, shown, _f(-FAINT))
            shown = where_greater(_HUGE, xx + yy, shown, _f(-INVALID))
            shown = where_greater(load(blocks, at + 10 * LANES), _HALF * _MARK, shown, _f(-INVALID))
            dx, dy, dz = mean[0] - view[16], mean[1] - view[17], mean[2] - view[18]
            shrink = _1 / square_root(maximum(dx * dx + dy * dy + dz * dz, _f(1e-24)))
            basis(dx * shrink, dy * shrink, dz * shrink, bands, tmp)
            red, green, blue = colour(blocks, at, bands, tmp)
            k = -_HALF * _LOG2E * invert
            inverse_xx = _1 / xx
            stores(tmp, 0, LANES, (
                px, py, k * yy, -_2 * k * xy, k * xx, highest,
                maximum(red, _0), maximum(green, _0), maximum(blue, _0), centre[2],
                shown, half_height, xy * inverse_xx, det * inverse_xx, inverse_xx, xy / yy * half_height,
            ))  # fmt: skip
            for lane in range(min(LANES, count - first)):
                o = (first + lane) * SLOTS
                for c in range(SLOTS):
                    splats_out[o + c] = tmp[c * LANES + lane]


@serial
def _grown(array, room):
    more = np.empty(room, array.dtype)
    more[: len(array)] = array
    return more


@serial
def bins(splats_in, count, width, height):
    """Entries of the Gaussians that are seen: sorted by tile, then by depth.

    Returns where each tile starts; Gaussian, slot and rows of each entry; where the slots of each Gaussian start
    [count + LANES + 1]; and how many Gaussians were left out as FAINT, BEHIND, OUTSIDE, INVALID. Slots number entries Gaussian
    by Gaussian. Depths closer than 2^-20 of what is seen keep their order.
    """
    across, down = (width + LANES - 1) // LANES, (height + ROWS - 1) // ROWS
    bits = splats_in.view(np.int32)
    first_slot = np.empty(count + 1 + LANES, np.int32)
    seen, key = np.empty(count, np.int32), np.empty(count, np.int32)
    room = 4 * count + 1024
    tile_of, rows_of = np.empty(room, np.int32), np.empty(room, np.int32)
    start = np.zeros(across * down + 1, np.int32)
    skipped = np.zeros(4, np.int64)
    visible, entries = 0, 0
    low, high = np.int32(0x7FFFFFFF), np.int32(0)
    for i in range(count):
        first_slot[i] = entries
        o = i * SLOTS
        rx = splats_in[o + 10]
        if not rx > 0:
            skipped[int(-rx)] += 1
            continue
        mx, my, ry = splats_in[o], splats_in[o + 1], splats_in[o + 11]
        x0, x1 = max(_0, np.ceil(mx - rx - _HALF)), min(_f(width - 1), np.floor(mx + rx - _HALF))
        y0, y1 = max(_0, np.ceil(my - ry - _HALF)), min(_f(height - 1), np.floor(my + ry - _HALF))
        if x0 > x1 or y0 > y1:
            skipped[OUTSIDE] += 1
            continue
        c0, c1, first, last = int(x0) // LANES, int(x1) // LANES, int(y0), int(y1)
        need = (c1 - c0 + 1) * (last // ROWS - first // ROWS + 1)
        if entries + need > room:
            room = 2 * room + need
            tile_of, rows_of = _grown(tile_of, room), _grown(rows_of, room)
        slope, part, inverse_xx, top = splats_in[o + 12], splats_in[o + 13], splats_in[o + 14], splats_in[o + 15]
        reach, before = rx * rx * inverse_xx, entries
        for c in range(c0, c1 + 1):
            ya, yz = first, last
            if c1 > c0:  # the rows that the ellipse covers between the first and the last pixel centre of the column
                u0, u1 = max(_f(c * LANES) + _HALF - mx, -rx), min(_f(c * LANES + LANES) - _HALF - mx, rx)
                ut, ub = min(max(top, u0), u1), min(max(-top, u0), u1)
                yt = slope * ut + np.sqrt(max(_0, part * (reach - ut * ut * inverse_xx)))
                yb = slope * ub - np.sqrt(max(_0, part * (reach - ub * ub * inverse_xx)))
                ya, yz = max(first, int(np.ceil(my + yb - _HALF))), min(last, int(np.floor(my + yt - _HALF)))
            if ya > yz:
                continue
            for r in range(ya // ROWS, yz // ROWS + 1):
                tile = r * across + c
                tile_of[entries] = tile
                rows_of[entries] = max(ya - r * ROWS, 0) | ((min(yz - r * ROWS, ROWS - 1) + 1) << 8)
                start[tile + 1] += 1
                entries += 1
        if entries > before:
            k = bits[o + 9]  # positive floats sort as their bits do
            low, high = min(low, k), max(high, k)
            seen[visible], key[visible] = i, k
            visible += 1
        else:
            skipped[OUTSIDE] += 1
    first_slot[count:] = entries
    order = _by_depth(seen[:visible], key[:visible], low, high)
    for tile in range(across * down):
        start[tile + 1] += start[tile]
    fill = start[:-1].copy()
    ids, slots, rows = np.empty(entries, np.int32), np.empty(entries, np.int32), np.empty(entries, np.int32)
    for i in order:
        for slot in range(first_slot[i], first_slot[i + 1]):
            at = fill[tile_of[slot]]
            fill[tile_of[slot]] = at + 1
            ids[at], slots[at], rows[at] = i, slot, rows_of[slot]
    return start, ids, slots, rows, first_slot, skipped


@serial
def _by_depth(seen, key, low, high):
    """Radix sort by 22 bits of the depth's range, 11 at a time."""
    shift = 0
    while (high - low) >> shift >= 1 << 22:
        shift += 1
    first, second = np.zeros(2049, np.int32), np.zeros(2049, np.int32)
    for q in range(len(seen)):
        key[q] = (key[q] - low) >> shift
        first[(key[q] & 2047) + 1] += 1
        second[(key[q] >> 11) + 1] += 1
    for c in range(2048):
        first[c + 1] += first[c]
        second[c + 1] += second[c]
    half, half_key, order = np.empty_like(seen), np.empty_like(key), np.empty_like(seen)
    for q in range(len(seen)):
        d = first[key[q] & 2047]
        first[key[q] & 2047] = d + 1
        half[d], half_key[d] = seen[q], key[q] >> 11
    for q in range(len(seen)):
        d = second[half_key[q]]
        second[half_key[q]] = d + 1
        order[d] = half[q]
    return order


def _composite(channels):
    @jit
    def composite(start, ids, rows, splats_in, values, stride, offset, background, width, height, out, left):
        """Planes out [channels, H16, W16] of values[stride * i + offset ...] and the transmittance left [H16, W16], both padded
        to whole tiles; returns how many entries were skipped because nothing passed any more."""
        across, down = (width + LANES - 1) // LANES, (height + ROWS - 1) // ROWS
        padded, area, tile_area = across * LANES, across * LANES * down * ROWS, ROWS * LANES
        skipped = np.zeros(across * down, np.int64)
        for tile in numba.prange(across * down):
            bx, by = tile % across * LANES, tile // across * ROWS
            passing = np.ones(tile_area, np.float32)
            seen = np.zeros(channels * tile_area, np.float32)
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
                    for y in range(first, last):
                        dy = _f(y) - my
                        power = p0 + dy * (p1 + p2 * dy)
                        alpha = where_greater(power, _LOG_MIN, minimum(exp2_rough(power), _MAX), _0)
                        d = y * LANES
                        t = load(passing, d)
                        weight = alpha * t
                        store(passing, d, t - weight)
                        stores(seen, d, tile_area, add_scaled(loads(seen, d, tile_area, channels), weight, value))
                k = stop
                while low < high and largest(load(passing, low * LANES)) < _STOP:
                    low += 1
                while low < high and largest(load(passing, (high - 1) * LANES)) < _STOP:
                    high -= 1
            skipped[tile] = end - k
            behind = splats(background, 0, channels)
            for y in range(ROWS):
                t = load(passing, y * LANES)
                d = (by + y) * padded + bx
                store(left, d, t)
                stores(out, d, area, add_scaled(loads(seen, y * LANES, tile_area, channels), t, behind))
        return skipped.sum()

    return composite


composite = {channels: _composite(channels) for channels in (3, 4, 8)}
"""Compositing of so many channels at once."""
