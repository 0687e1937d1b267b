"""Compiled backward pass of the rasteriser of 3D Gaussians; blocks are those of
`layout`, splats and entries those of `tile_kernels`.

Of every entry SUMS floats are kept: the sums over its pixels of p, p dx, p dx^2, p dy, p dx dy, p dy^2, where
p is dL / d ln alpha, then of weight times the gradient of each channel. Slots of one Gaussian lie together,
so its sums have one order on any number of threads.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

import itertools
import math
from typing import Annotated, Any

import numpy as np

from ..simd import (
    LANES,
    aligned,
    load,
    lowest_bit,
    prefetch,
    splat,
    square_root,
    stack,
    store,
    sums,
    swapped,
    traced,
    transposed,
    where_greater,
)
from ..threads import on_threads, take
from . import ADAM_DECAYS, ADAM_EPSILON, BLUR, MAX_ALPHA, MAX_SQUARE_PIXELS
from .forward_kernels import (
    AHEAD,
    CHUNK,
    TILE,
    Channels,
    alpha_of,
    axes,
    bend,
    block_places,
    entry_of,
    footprint,
    inside,
    opacity,
    open_blocks,
)
from .layout import BLOCKS, FIXED, Floats, basis, colour, direction, direction_slopes, jit
from .tile_kernels import SIDE, SLOTS, Tiles

SUMS = LANES
"""Floats that are kept of an entry: a vector."""
GEOMETRY = 6
"""Sums of an entry that are about its shape; those of channels follow."""
CAMERA = 6
"""Degrees of freedom of a camera."""
_LOG_MAX = math.log2(MAX_ALPHA)
"""log2 alpha above which it is cut."""
_BLOCK_SUMS = SUMS * LANES


@traced
def _begin(
    row, memory, channels, geometry, bx, by, width, height, out, left, grad, grad_left, d, padded, area
):
    """Of four rows of pixels: transmittance; what is behind everything so far, times the gradient; the
    gradient.
    """
    at = row * (4 * LANES)
    behind = []
    for k in range(4):
        x = bx + 4 * k
        y = by + row * 4
        store(memory, at + k * LANES, inside(memory, x, y, 0, width, height))
    if geometry:
        behind = [load(grad_left, d + padded * y) * load(left, d + padded * y) for y in range(4)]
    for c in range(channels):
        g = [load(grad, area * c + d + padded * y) for y in range(4)]
        for k, each in enumerate(swapped(g)):
            store(memory, at + k * LANES + (2 + c) * TILE, each)
        if geometry:
            behind = [behind[y] + g[y] * load(out, area * c + d + padded * y) for y in range(4)]
    for k, each in enumerate(swapped(behind) if geometry else ()):
        store(memory, at + k * LANES + TILE, each)


@traced
def _nothing(memory, count):
    return [splat(memory, 0)] * count


@traced
def _composite_block(entry, block, memory, places, found, geometry):
    """Add a block to the sums of an entry: those of the shape, then of channels."""
    # Alpha as in the forward pass, and what it lets pass.
    dx, dy, a, b, c, d, *value = entry
    dx = dx + memory[block + places]
    dy = dy + memory[block + places + LANES]
    power = d + dx * (a * dx + b * dy) + c * dy * dy
    alpha = alpha_of(power)
    at = block * LANES
    passing = load(memory, at)
    weight = alpha * passing
    store(memory, at, passing - weight)
    slope = [load(memory, at + (2 + k) * TILE) for k in range(len(value))]
    shape = found[:GEOMETRY] if geometry else ()
    summed = [each + weight * g for each, g in zip(found[len(shape) :], slope, strict=True)]
    if not geometry:
        return summed
    # dL / d ln alpha = weight <value, gradient> - alpha / (1 - alpha) <what is behind, gradient>.
    gain = splat(memory, 0)
    for each, g in zip(value, slope, strict=True):
        gain = gain + each * g
    gain = weight * gain
    behind = load(memory, at + TILE) - gain
    store(memory, at + TILE, behind)
    p = gain - behind * (alpha / (1 - alpha))
    p = where_greater(_LOG_MAX, power, p, 0)  # a cut alpha does not move
    px = p * dx
    py = p * dy
    moments = (p, px, px * dx, py, px * dy, py * dy)
    return *(each + moment for each, moment in zip(shape, moments, strict=True)), *summed


@traced
def _keep(summed, found, at):
    store(found, at, sums(summed))


def _composite_back(channels, geometry):
    places = TILE * (2 + channels)
    count = channels + GEOMETRY * geometry
    room = places + 2 * LANES

    @jit
    def composite_back(
        counters, start, ids, slots, blocks, splats_in, values, stride, offset, width, height, out, left, grad, grad_left, found
    ):  # fmt: skip
        across = (width + SIDE - 1) // SIDE
        down = (height + SIDE - 1) // SIDE
        padded = across * SIDE
        area = across * SIDE * down * SIDE
        memory = stack(room)
        block_places(memory, places)
        while True:
            tile = take(counters, 0)
            if tile >= across * down:
                break
            bx = tile % across * SIDE
            by = tile // across * SIDE
            for row in range(4):
                d = (by + 4 * row) * padded + bx
                _begin(
                    row, memory, channels, geometry, bx, by, width, height, out, left, grad, grad_left, d, padded, area
                )  # fmt: skip
            # Front to back as in the forward pass, with the same blocks left alone.
            k = start[tile]
            end = start[tile + 1]
            unsaturated = 0xFFFF
            while k < end and unsaturated != 0:
                stop = min(k + CHUNK, end)
                for q in range(k, stop):
                    prefetch(splats_in, ids[min(q + AHEAD, end - 1)] * SLOTS)
                    todo = blocks[q] & unsaturated
                    summed = _nothing(memory, count)
                    if todo != 0:
                        entry = entry_of(
                            splats_in, ids[q] * SLOTS, bx, by, values, ids[q] * stride + offset, channels
                        )
                        while todo != 0:
                            summed = _composite_block(
                                entry, lowest_bit(todo), memory, places, summed, geometry
                            )
                            todo &= todo - 1
                    _keep(summed, found, slots[q] * SUMS)
                k = stop
                unsaturated = open_blocks(memory)
            for q in range(k, end):
                store(found, slots[q] * SUMS, 0)

    return composite_back


# By the number of channels: one is compiled when it is first called.
_COMPOSITE_BACK = {channels: _composite_back(channels, 1) for channels in (3, 4, 8)}
# Of features alone, without the sums of the shape.
_LIFT = {channels: _composite_back(channels, 0) for channels in (8, SUMS)}


def composite_back(
    tiles: Tiles,
    channels: Channels,
    out: Floats,
    left: Floats,
    grad: Floats,
    grad_left: Floats,
    sums: Floats | None = None,
) -> Floats:
    """SUMS of each slot, from the planes of `composite` and their gradients, both padded to whole tiles; in
    `sums`, where room of at least `sums_of` floats is given.
    """
    kernel = _COMPOSITE_BACK[channels.number]
    return _summed(kernel, tiles, channels, sums, out, left, grad, grad_left)


def lift(tiles: Tiles, count: int, pixels: Floats) -> Floats:
    """SUMS of each slot that begin with those of 8 or 16 channels, of weight times pixel; there are none of
    the shape.
    """
    nothing = np.empty(0, np.float32)
    channels = Channels(count, tiles.splats, SLOTS, 0)
    return _summed(_LIFT[count], tiles, channels, None, nothing, nothing, pixels, nothing)


def sums_of(tiles: Tiles) -> int:
    """Floats of the sums of all slots, with a spare one."""
    return (len(tiles.ids) + 1) * SUMS


def _summed(kernel: Any, tiles: Tiles, channels: Channels, room: Floats | None, *planes: Floats) -> Floats:
    sums = aligned(sums_of(tiles)) if room is None else room
    on_threads(
        kernel, tiles.start, tiles.ids, tiles.slots, tiles.blocks, tiles.splats,
        channels.values, channels.stride, channels.first, tiles.width, tiles.height, *planes, sums,
    )  # fmt: skip
    return sums


@traced
def _add(memory, at, found, slot):
    store(memory, at, load(memory, at) + load(found, slot))


@jit
def _lift_values(counters, found, first_slot, count, out, stride, offset, channels, skipped):
    memory = stack(SUMS)
    while True:
        begin = take(counters, 0) * BLOCKS * LANES
        if begin >= count:
            break
        for i in range(begin, min(count, begin + BLOCKS * LANES)):
            store(memory, 0, 0)
            for slot in range(first_slot[i], first_slot[i + 1]):
                _add(memory, 0, found, slot * SUMS)
            for c in range(channels):
                out[i * stride + offset + c] = memory[skipped + c]


def lift_values(
    tiles: Tiles,
    found: Floats,
    out: Floats,
    stride: int,
    offset: int,
    channels: int,
    *,
    skipped: int = GEOMETRY,
) -> None:
    """out[stride * i + offset ...] = the sums of the channels of each Gaussian, which follow on `skipped`
    others.
    """
    on_threads(_lift_values, found, tiles.first_slot, tiles.total, out, stride, offset, channels, skipped)


def _block_gradient(blocks, at, bands, lens, view, summed):
    """The gradient of the parameters of a block, a vector a row, from sums: shape (6), colour, depth; and its
    part of the gradient of the camera: the turn about its own centre (rotation vector in camera axes), and
    the shift in the world.

    Sigma' = -Sigma^-1 G Sigma^-1 turns the shape's sums into those of the covariance; then back through
    `footprint` and `axes`. A camera that turns and shifts sees what it would see if all Gaussians did the
    opposite.
    """
    mean, centre, scales, (qw, qx, qy, qz, q_inverse), world, camera = axes(blocks, at, view)
    tangents, (across, down), (j00, j01, j02, j10, j11, j12), (xx0, yy0, xy, det0) = footprint(
        centre, camera, view, lens
    )
    u, v, near_u, near_v, inverse, fx, fy = tangents
    xx = xx0 + BLUR
    yy = yy0 + BLUR
    det = det0 + BLUR * (xx0 + yy0) + BLUR * BLUR
    invert = 1 / det
    s0, sx, sxx, sy, sxy, syy, red, green, blue, depth = summed[:10]
    # What is not drawn has sums of 0, but may have infinite factors.
    drawn = where_greater(centre[2], view[23], where_greater(MAX_SQUARE_PIXELS, xx + yy, splat(xx, 1), 0), 0)

    # Image position and covariance.
    ca = yy * invert
    cb = -xy * invert
    cc = xx * invert
    g_px = ca * sx + cb * sy
    g_py = cb * sx + cc * sy
    e00 = ca * sxx + cb * sxy
    e01 = ca * sxy + cb * syy
    e10 = cb * sxx + cc * sxy
    e11 = cb * sxy + cc * syy
    g_xx = 0.5 * (e00 * ca + e01 * cb)
    g_yy = 0.5 * (e10 * cb + e11 * cc)
    g_xy = e00 * cb + e01 * cc
    ratio = det0 * invert  # anti-aliased: alpha falls with its square root
    k = where_greater(view[24], 0, 0.5 * s0 / (ratio + 1e-8) * invert, 0)
    g_xx = g_xx + k * (yy0 - ratio * yy)
    g_yy = g_yy + k * (xx0 - ratio * xx)
    g_xy = g_xy - 2 * k * xy * (1 - ratio)

    # Axes in pixels, then in camera and world coordinates.
    h00 = 2 * g_xx * j00 + g_xy * j10
    h01 = 2 * g_xx * j01 + g_xy * j11
    h02 = 2 * g_xx * j02 + g_xy * j12
    h10 = 2 * g_yy * j10 + g_xy * j00
    h11 = 2 * g_yy * j11 + g_xy * j01
    h12 = 2 * g_yy * j12 + g_xy * j02
    g_z = -inverse * (j00 * h00 + j01 * h01 + j02 * h02 + j10 * h10 + j11 * h11 + j12 * h12)
    g_z = g_z + depth
    h00 = h00 * fx
    h01 = h01 * fx
    h02 = h02 * fx
    h10 = h10 * fy
    h11 = h11 * fy
    h12 = h12 * fy
    # Through the lens: of the axes before it (p), and of its derivative uu, uv, vv, which moves with the tangents.
    p00, p01, p02, p10, p11, p12 = (h00, h01, h02, h10, h11, h12)
    of_near_u = 0
    of_near_v = 0
    g_u = view[12] * g_px
    g_v = view[13] * g_py
    if lens:
        of_uu = h00 * across[0] + h01 * across[1] + h02 * across[2]
        of_uv = h00 * down[0] + h01 * down[1] + h02 * down[2]
        of_uv = of_uv + h10 * across[0] + h11 * across[1] + h12 * across[2]
        of_vv = h10 * down[0] + h11 * down[1] + h12 * down[2]
        twice = 2 * view[25]
        of_near_u = twice * (near_u * (3 * of_uu + of_vv) + near_v * of_uv)
        of_near_v = twice * (near_v * (of_uu + 3 * of_vv) + near_u * of_uv)
        uu, uv, vv = bend(near_u, near_v, view)
        p00, p01, p02 = (uu * x + uv * y for x, y in ((h00, h10), (h01, h11), (h02, h12)))
        p10, p11, p12 = (uv * x + vv * y for x, y in ((h00, h10), (h01, h11), (h02, h12)))
        uu, uv, vv = bend(u, v, view)
        of_shown = g_u
        g_u = uu * of_shown + uv * g_v
        g_v = uv * of_shown + vv * g_v
    inside_u = where_greater(u, view[19], where_greater(view[20], u, splat(u, 1), 0), 0)
    inside_v = where_greater(v, view[21], where_greater(view[22], v, splat(v, 1), 0), 0)
    g_u = g_u - inside_u * (camera[6] * p00 + camera[7] * p01 + camera[8] * p02 - of_near_u)
    g_v = g_v - inside_v * (camera[6] * p10 + camera[7] * p11 + camera[8] * p12 - of_near_v)
    g_x = g_u * inverse
    g_y = g_v * inverse
    g_z = g_z - (u * g_u + v * g_v) * inverse
    b0 = -(near_u * p00 + near_v * p10)
    b1 = -(near_u * p01 + near_v * p11)
    b2 = -(near_u * p02 + near_v * p12)
    columns = ((p00, p10, b0), (p01, p11, b1), (p02, p12, b2))
    n = []
    for r in range(3):
        n.append([view[r] * h0 + view[3 + r] * h1 + view[6 + r] * b for h0, h1, b in columns])
    of_scales = [n[0][c] * world[c] + n[1][c] * world[3 + c] + n[2][c] * world[6 + c] for c in range(3)]
    pairs = [(centre, (g_x, g_y, g_z))]
    pairs += [(camera[c::3], g) for c, g in enumerate(columns)]
    of_turn = []
    for r in range(3):
        after = (r + 1) % 3
        before = (r + 2) % 3
        of_turn.append(sum(g[after] * a[before] - g[before] * a[after] for a, g in pairs))

    # Quaternion: of the unit one, then across it.
    n00, n01, n02 = (each * s for each, s in zip(n[0], scales, strict=True))
    n10, n11, n12 = (each * s for each, s in zip(n[1], scales, strict=True))
    n20, n21, n22 = (each * s for each, s in zip(n[2], scales, strict=True))
    kw = 2 * (qx * (n21 - n12) + qy * (n02 - n20) + qz * (n10 - n01))
    kx = 2 * (qy * (n01 + n10) + qz * (n02 + n20) + qw * (n21 - n12) - 2 * qx * (n11 + n22))
    ky = 2 * (qx * (n01 + n10) + qz * (n12 + n21) + qw * (n02 - n20) - 2 * qy * (n00 + n22))
    kz = 2 * (qx * (n02 + n20) + qy * (n12 + n21) + qw * (n10 - n01) - 2 * qz * (n00 + n11))
    along = kw * qw + kx * qx + ky * qy + kz * qz
    of_quaternion = [(k - q * along) * q_inverse for k, q in ((kw, qw), (kx, qx), (ky, qy), (kz, qz))]

    # Colour: no gradient where it is cut at 0.
    dx, dy, dz, shrink = direction(mean, view)
    values = basis(dx, dy, dz, bands)
    uncut = colour(blocks, at, values)
    colours = [
        where_greater(uncut[0], 0, red, 0),
        where_greater(uncut[1], 0, green, 0),
        where_greater(uncut[2], 0, blue, 0),
    ]
    gx, gy, gz = direction_slopes((dx, dy, dz), bands, blocks, at, colours)
    along = gx * dx + gy * dy + gz * dz
    of_means = []
    for r, (g, d) in enumerate(((gx, dx), (gy, dy), (gz, dz))):
        of_place = view[r] * g_x + view[3 + r] * g_y + view[6 + r] * g_z
        of_means.append(of_place + (g - d * along) * shrink)
    of_shape = [where_greater(drawn, 0, each, 0) for each in (*of_means, *of_scales, *of_quaternion)]
    of_shift = [-each for each in of_means]
    of_camera = [where_greater(drawn, 0, each, 0) for each in (*of_turn, *of_shift)]
    of_colours = []
    for b in values:
        of_colours += [b * each for each in colours]
    return [*of_shape, s0 * (1 - opacity(load(blocks, at + 10 * LANES))), *of_colours], of_camera


@traced
def _learn_block(blocks, first, second, weight, start, bands, lens, view, memory, rates, of_camera, to):
    at = start * (FIXED + 3 * bands)
    # Adam, whose second moment is weighted by how often a Gaussian was seen.
    w = load(weight, start)
    w = w + (1 - ADAM_DECAYS[1]) * (1 - w)
    store(weight, start, w)
    summed = transposed([load(memory, lane * LANES) for lane in range(LANES)])[: GEOMETRY + 3]
    rows, of_view = _block_gradient(blocks, at, bands, lens, view, [*summed, 0])
    for row, g in enumerate(of_view):
        store(of_camera, to + row * LANES, load(of_camera, to + row * LANES) + g)
    for row, g in enumerate(rows):
        o = at + row * LANES
        m = load(first, o)
        s = load(second, o)
        m = m + (1 - ADAM_DECAYS[0]) * (g - m)
        s = s + (1 - ADAM_DECAYS[1]) * (g * g - s)
        store(first, o, m)
        store(second, o, s)
        store(blocks, o, load(blocks, o) - rates[row] * m / (square_root(s / w) + ADAM_EPSILON))


@traced
def _write_gradient(blocks, at, bands, lens, view, memory, out):
    summed = transposed([load(memory, lane * LANES) for lane in range(LANES)])[: GEOMETRY + 4]
    for row, g in enumerate(_block_gradient(blocks, at, bands, lens, view, summed)[0]):
        store(out, at + row * LANES, g)


@jit
def _add_block(found, first_slot, first, memory):
    """The sums of LANES Gaussians, a vector each."""
    for lane in range(LANES):
        store(memory, lane * LANES, 0)
        for slot in range(first_slot[first + lane], first_slot[first + lane + 1]):
            _add(memory, lane * LANES, found, slot * SUMS)


def _gradients(bands, lens):
    @jit
    def gradients(counters, blocks, count, view, found, first_slot, out):
        memory = stack(_BLOCK_SUMS)
        while True:
            begin = take(counters, 0) * BLOCKS * LANES
            if begin >= count:
                break
            for first in range(begin, min(count, begin + BLOCKS * LANES), LANES):
                at = first * (FIXED + 3 * bands)
                if first_slot[first + LANES] == first_slot[first]:
                    for row in range(FIXED + 3 * bands):
                        store(out, at + row * LANES, 0)
                else:
                    _add_block(found, first_slot, first, memory)
                    _write_gradient(blocks, at, bands, lens, view, memory, out)

    return gradients


def _adam(bands, lens):
    @jit
    def adam(counters, blocks, first, second, weight, count, view, found, first_slot, rates, of_camera):
        memory = stack(_BLOCK_SUMS)
        while True:
            begin = take(counters, 0) * BLOCKS * LANES
            if begin >= count:
                break
            for start in range(begin, min(count, begin + BLOCKS * LANES), LANES):
                if first_slot[start + LANES] > first_slot[start]:
                    _add_block(found, first_slot, start, memory)
                    _learn_block(
                        blocks, first, second, weight, start, bands, lens,
                        view, memory, rates, of_camera, begin // BLOCKS * CAMERA
                    )  # fmt: skip

    return adam


# By the number of harmonics, and 1 where there is a lens.
_KEYS = tuple(itertools.product((1, 4, 9, 16), (0, 1)))
_GRADIENTS = {key: _gradients(*key) for key in _KEYS}
_ADAM = {key: _adam(*key) for key in _KEYS}


def gradients(tiles: Tiles, blocks: Floats, bands: int, view: Floats, found: Floats, out: Floats) -> None:
    """The gradients of all Gaussians, in blocks, from the sums of their slots: shape, colour and depth."""
    on_threads(_GRADIENTS[bands, int(view[25] != 0)], blocks, tiles.total, view, found, tiles.first_slot, out)


def adam(
    tiles: Tiles,
    blocks: Floats,
    moments: tuple[Floats, Floats, Floats],
    bands: int,
    view: Floats,
    found: Floats,
    rates: Floats,
) -> Annotated[np.ndarray[Any, np.dtype[np.float64]], "6"]:
    """One step of Adam, in place, for the blocks that have an entry; the others keep their moments as well.

    Returns the gradient of the camera, float64: its turn about its own centre (rotation vector in camera
    axes) and its shift.

    found: sums of shape and colour. rates: a learning rate for each row of a block. moments: the first, the
    second, and the sum of the weights in the second of a Gaussian, 1 - 0.99^k after k steps: what is seen for
    the first time moves as it would have in the first step. The first moment is not corrected, so the rates
    rise over a Gaussian's first ten steps.
    """
    # Of the Gaussians that a thread takes at a time, so that threads do not change the order of the sum.
    of_camera = np.zeros((-(-tiles.total // (BLOCKS * LANES)), CAMERA, LANES), np.float32)
    on_threads(
        _ADAM[bands, int(view[25] != 0)],
        blocks,
        *moments,
        tiles.total,
        view,
        found,
        tiles.first_slot,
        rates,
        of_camera.reshape(-1),
    )
    gradient: np.ndarray[Any, np.dtype[np.float64]] = of_camera.sum((0, 2), dtype=np.float64)
    return gradient


def cache_path(bands: int) -> str:
    """The folder where numba keeps what it compiled of this module."""
    return str(_ADAM[bands, 0].stats.cache_path)
