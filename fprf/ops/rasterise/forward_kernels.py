"""Compiled forward pass of the rasteriser of 3D Gaussians: projection, tiles, compositing. `rasterise` is
their bridge.

Blocks     Parameters of LANES Gaussians, a row each (`layout`).
Camera     26 numbers: rotation world to camera 0-8, translation 9-11, fx fy cx cy 12-15, place in the world 16-18, limits of
           the tangents (left right top bottom) 19-22, near 23, 1 for anti-aliasing 24, radial distortion k1 25.
Splats, tiles and entries are those of `tile_kernels`.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

import itertools
import math
from typing import NamedTuple

import numpy as np

from ..simd import (
    LANES,
    as_float,
    exp2,
    greater_bits,
    lanes,
    load,
    log2,
    lowest_bit,
    maximum,
    minimum,
    prefetch,
    splat,
    square_root,
    stack,
    store,
    swapped,
    traced,
    transposed,
    where_greater,
)
from ..threads import on_threads, take
from . import BLUR, MAX_ALPHA, MAX_SQUARE_PIXELS, MIN_ALPHA
from .layout import BLOCKS, FIXED, MARK, MIN_SQUARED_NORM, Floats, basis, colour, direction, jit
from .tile_kernels import BEHIND, FAINT, INVALID, OUTSIDE, SIDE, SLOTS, Tiles, tiles_of

STOP = 1e-3
"""Blocks of a tile through which no more than this share of light passes are left alone: an error of at most
a quarter of a step of 8 bits.
"""
CHUNK = 32
"""Entries of a tile between looks at which of its blocks light still passes; by eye."""
AHEAD = 16
"""Entries ahead of the one at work, whose splats are fetched into the cache; by eye."""
_f = np.float32
_LOG2E = 1 / math.log(2)
"""e^x = 2^(x _LOG2E)."""
_LN2 = math.log(2)
"""ln x = _LN2 log2 x."""
LOG_MIN = _f(math.log2(MIN_ALPHA))
"""log2 alpha that counts as 0."""


def axes(blocks, at, view):
    """Camera coordinates of the means, and the scaled axes of the Gaussians in world and in camera
    coordinates.
    """
    x, y, z = (load(blocks, at + c * LANES) for c in range(3))
    mean = x, y, z
    centre = [view[3 * r] * x + view[3 * r + 1] * y + view[3 * r + 2] * z + view[9 + r] for r in range(3)]
    # The unit quaternion; one of zeros is no rotation.
    w, x, y, z = (load(blocks, at + c * LANES) for c in range(6, 10))
    shrink = 1 / square_root(maximum(w * w + x * x + y * y + z * z, MIN_SQUARED_NORM))
    w = w * shrink
    x = x * shrink
    y = y * shrink
    z = z * shrink
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    # Columns of R S are the ellipsoid's half axes.
    scales = [exp2(load(blocks, at + c * LANES) * _LOG2E) for c in range(3, 6)]
    world = [rows[k] * scales[k % 3] for k in range(9)]
    camera = []
    for r in range(3):
        for c in range(3):
            turned = view[3 * r] * world[c] + view[3 * r + 1] * world[3 + c] + view[3 * r + 2] * world[6 + c]
            camera.append(turned)
    return mean, centre, scales, (w, x, y, z, shrink), world, camera


def footprint(centre, camera, view, lens):
    """The image position u, v (tangents without the lens), the axes in pixels j, their covariance xx, yy, xy and
    its determinant, blur apart. Where there is no `lens` k1 is not read: the terms of one take 12 % of a step with
    400 000 Gaussians.

    The determinant is the squared length of a cross product: xx yy - xy^2 would lose the digits of thin
    ellipses.
    """
    cx, cy, cz = centre
    inverse = 1 / where_greater(cz, view[23], cz, 1)
    u = cx * inverse
    v = cy * inverse
    near_u = minimum(maximum(u, view[19]), view[20])
    near_v = minimum(maximum(v, view[21]), view[22])
    fx = view[12] * inverse
    fy = view[13] * inverse
    across = [camera[c] - near_u * camera[6 + c] for c in range(3)]
    down = [camera[3 + c] - near_v * camera[6 + c] for c in range(3)]
    if lens:
        uu, uv, vv = bend(near_u, near_v, view)
        j00, j01, j02 = (fx * (uu * across[c] + uv * down[c]) for c in range(3))
        j10, j11, j12 = (fy * (uv * across[c] + vv * down[c]) for c in range(3))
    else:
        j00, j01, j02 = (fx * each for each in across)
        j10, j11, j12 = (fy * each for each in down)
    xx = j00 * j00 + j01 * j01 + j02 * j02
    yy = j10 * j10 + j11 * j11 + j12 * j12
    xy = j00 * j10 + j01 * j11 + j02 * j12
    c0 = j01 * j12 - j02 * j11
    c1 = j02 * j10 - j00 * j12
    c2 = j00 * j11 - j01 * j10
    return (
        (u, v, near_u, near_v, inverse, fx, fy),
        (across, down),
        (j00, j01, j02, j10, j11, j12),
        (xx, yy, xy, c0 * c0 + c1 * c1 + c2 * c2),
    )


def bend(u, v, view):
    """Derivatives of u (1 + k1 r^2) by u and v, and of v (1 + k1 r^2) by v."""
    k1 = view[25]
    return 1 + k1 * (3 * u * u + v * v), 2 * k1 * u * v, 1 + k1 * (u * u + 3 * v * v)


def opacity(logit):
    """Sigmoid."""
    return 1 / (1 + exp2(logit * -_LOG2E))


@traced
def _project_block(blocks, at, bands, lens, view, width, height, splats_out, to):
    # Sigma' and its inverse, whose determinants differ by the blur.
    mean, centre, _, _, _, camera = axes(blocks, at, view)
    (u, v, *_), _, _, (xx0, yy0, xy, det0) = footprint(centre, camera, view, lens)
    xx = xx0 + BLUR
    yy = yy0 + BLUR
    det = det0 + BLUR * (xx0 + yy0) + BLUR * BLUR
    invert = 1 / det
    # Opacity, fainter where the blur makes it wider.
    logit = load(blocks, at + 10 * LANES)
    alpha = opacity(logit)
    alpha = where_greater(view[24], 0, alpha * square_root(det0 * invert + 1e-8), alpha)
    highest = log2(alpha)
    # Where log2 alpha falls below that of MIN_ALPHA: (dx, dy) Sigma^-1 (dx, dy) = reach.
    reach = (highest - LOG_MIN) * (2 * _LN2)
    half_width = square_root(maximum(reach, 0) * xx)
    half_height = square_root(maximum(reach, 0) * yy)
    bent = 0
    if lens:
        bent = view[25] * (u * u + v * v)
        u = u * (1 + bent)
        v = v * (1 + bent)
    px = view[12] * u + view[14]
    py = view[13] * v + view[15]
    # Half the width, or why there is nothing to draw.
    shown = where_greater(as_float(width), px - half_width, half_width, -OUTSIDE)
    shown = where_greater(px + half_width, 0, shown, -OUTSIDE)
    shown = where_greater(as_float(height), py - half_height, shown, -OUTSIDE)
    shown = where_greater(py + half_height, 0, shown, -OUTSIDE)
    if lens:
        shown = where_greater(1 + 3 * bent, 0, shown, -OUTSIDE)  # beyond it the lens folds back
    shown = where_greater(centre[2], view[23], shown, -BEHIND)
    shown = where_greater(reach, 0, shown, -FAINT)
    shown = where_greater(MAX_SQUARE_PIXELS, xx + yy, shown, -INVALID)
    shown = where_greater(logit, 0.5 * MARK, shown, -INVALID)
    colours = (maximum(each, 0) for each in colour(blocks, at, basis(*direction(mean, view)[:3], bands)))
    # log2 alpha as a polynomial of the distance; a row of splats a Gaussian.
    k = -0.5 * _LOG2E * invert
    inverse_yy = 1 / yy
    rows = [
        px, py, k * yy, -2 * k * xy, k * xx, highest, *colours, centre[2],
        shown, half_height, xy * inverse_yy, det * inverse_yy, inverse_yy, xy / xx * half_width,
    ]  # fmt: skip
    for lane, each in enumerate(transposed(rows)):
        store(splats_out, to + lane * SLOTS, each)


def _project(bands, lens):
    @jit
    def project(counters, blocks, count, view, width, height, splats_out):
        while True:
            begin = take(counters, 0) * BLOCKS * LANES
            if begin >= count:
                break
            for first in range(begin, min(count, begin + BLOCKS * LANES), LANES):
                _project_block(
                    blocks, first * (FIXED + 3 * bands), bands, lens, view, width, height, splats_out, first * SLOTS
                )  # fmt: skip

    return project


# By the number of harmonics, and 1 where there is a lens: one is compiled when it is first called.
_PROJECT = {key: _project(*key) for key in itertools.product((1, 4, 9, 16), (0, 1))}


def see(
    blocks: Floats, count: int, bands: int, view: Floats, width: int, height: int, splats: Floats
) -> Tiles:
    """Project `count` Gaussians and sort them into the tiles of an image. `splats` is room for whole blocks
    of them.
    """
    on_threads(_PROJECT[bands, int(view[25] != 0)], blocks, count, view, width, height, splats)
    return tiles_of(splats, count, width, height)


TILE = SIDE * SIDE
# Places of the pixels of a block of 4 x 4.
_X = [k % 4 for k in range(LANES)]
_Y = [k // 4 for k in range(LANES)]  # row by row


def inside(like, bx, by, block, width, height):
    """1 for the pixels of a block that are in the image, else 0."""
    x = lanes(like, _X) + (as_float(bx) + block % 4 * 4)
    y = lanes(like, _Y) + (as_float(by) + block // 4 * 4)
    return where_greater(as_float(width), x, where_greater(as_float(height), y, splat(like, 1), 0), 0)


@traced
def block_places(memory, at):
    """Left and upper edges of the blocks of a tile, to memory."""
    store(memory, at, lanes(memory, [4 * x for x in _X]))
    store(memory, at + LANES, lanes(memory, [4 * y for y in _Y]))


@traced
def open_blocks(memory):
    """A bit for each block of a tile through which light passes; memory begins with its transmittance."""
    most, *others = transposed([load(memory, block * LANES) for block in range(LANES)])
    for each in others:
        most = maximum(most, each)
    return greater_bits(most, STOP)


def alpha_of(power):
    """Alpha from its log2, which is at most 0."""
    return where_greater(power, LOG_MIN, minimum(exp2(power, 3), MAX_ALPHA), 0)


@traced
def entry_of(splats_in, o, bx, by, values, at, channels):
    """dx and dy of the pixels of a tile's first block, the polynomial of log2 alpha, and the values of a
    Gaussian.
    """
    dx = lanes(splats_in, _X) + 0.5 + as_float(bx) - splats_in[o]
    dy = lanes(splats_in, _Y) + 0.5 + as_float(by) - splats_in[o + 1]
    return dx, dy, *(splats_in[o + k] for k in range(2, 6)), *(values[at + c] for c in range(channels))


@traced
def _composite_block(entry, block, memory, places):
    dx, dy, a, b, c, d, *value = entry
    dx = dx + memory[block + places]
    dy = dy + memory[block + places + LANES]
    alpha = alpha_of(d + dx * (a * dx + b * dy) + c * dy * dy)
    at = block * LANES
    passing = load(memory, at)
    weight = alpha * passing
    store(memory, at, passing - weight)
    for k, each in enumerate(value):
        o = at + (k + 1) * TILE
        store(memory, o, load(memory, o) + weight * each)


@traced
def _begin(memory, channels, bx, by, width, height):
    for block in range(LANES):
        store(memory, block * LANES, inside(memory, bx, by, block, width, height))
        for c in range(channels):
            store(memory, block * LANES + (c + 1) * TILE, 0)


@traced
def _finish(row, memory, background, channels, out, left, d, padded, area):
    """Four rows of pixels."""
    blocks = [load(memory, row * (4 * LANES) + k * LANES) for k in range(4)]
    for y, each in enumerate(swapped(blocks)):
        store(left, d + padded * y, each)
    for c in range(channels):
        seen = []
        for k in range(4):
            summed = load(memory, row * (4 * LANES) + k * LANES + (c + 1) * TILE)
            seen.append(summed + blocks[k] * background[c])
        for y, each in enumerate(swapped(seen)):
            store(out, area * c + d + padded * y, each)


def _composite(channels):
    places = TILE * (1 + channels)
    room = places + 2 * LANES

    @jit
    def composite(
        counters, start, ids, blocks, splats_in, values, stride, offset, background, width, height, out, left
    ):
        across = (width + SIDE - 1) // SIDE
        down = (height + SIDE - 1) // SIDE
        padded = across * SIDE
        area = across * SIDE * down * SIDE
        skipped = 0
        memory = stack(room)  # transmittance, sums of the channels, places of the blocks
        block_places(memory, places)
        while True:
            tile = take(counters, 0)
            if tile >= across * down:
                break
            bx = tile % across * SIDE
            by = tile // across * SIDE
            # Nothing passes outside of the image.
            _begin(memory, channels, bx, by, width, height)
            k = start[tile]
            end = start[tile + 1]
            unsaturated = 0xFFFF
            while k < end and unsaturated != 0:
                stop = min(k + CHUNK, end)
                for q in range(k, stop):
                    prefetch(splats_in, ids[min(q + AHEAD, end - 1)] * SLOTS)
                    todo = blocks[q] & unsaturated
                    if todo != 0:
                        entry = entry_of(
                            splats_in, ids[q] * SLOTS, bx, by, values, ids[q] * stride + offset, channels
                        )
                        while todo != 0:
                            _composite_block(entry, lowest_bit(todo), memory, places)
                            todo &= todo - 1
                # Blocks that hardly any light passes are left alone from here on.
                k = stop
                unsaturated = open_blocks(memory)
            skipped += end - k
            for row in range(4):
                _finish(
                    row, memory, background, channels, out, left, (by + 4 * row) * padded + bx, padded, area
                )
        return skipped

    return composite


# By the number of channels.
_COMPOSITE = {channels: _composite(channels) for channels in (3, 4, 8)}


class Channels(NamedTuple):
    """Channels that are composited at once: 3, 4 or 8 (16 in `lift`) numbers of each Gaussian, values[stride *
    i + first ...].
    """

    number: int
    values: Floats
    stride: int
    first: int


def composite(tiles: Tiles, channels: Channels, background: Floats, out: Floats, left: Floats) -> int:
    """Planes out [channels, H16, W16] and the transmittance left [H16, W16], both padded to whole tiles;
    returns how many entries were skipped because nothing passed any more.
    """
    count, values, stride, first = channels
    return sum(
        on_threads(
            _COMPOSITE[count], tiles.start, tiles.ids, tiles.blocks, tiles.splats, values, stride, first, background,
            tiles.width, tiles.height, out, left,
        )
    )  # fmt: skip
