"""Compiled search for what each tile of an image shows, in the rasteriser of 3D Gaussians.

Splats     SLOTS numbers a Gaussian after projection: x y 0-1, A B C D with log2 alpha = A dx^2 + B dx dy + C dy^2 + D 2-5, red
           green blue 6-8, depth 9, half width and height of the ellipse where alpha is 1/255 10-11, then what
           cuts it into columns 12-15: xy/yy, det/yy, 1/yy, and dy of its right end. A half width of no more
           than 0 says why there is nothing to draw: FAINT, BEHIND, OUTSIDE, INVALID.
Tiles      16 x 16 pixels in 16 blocks of 4 x 4, row by row; such a block of pixels is a vector.
Entries    A Gaussian in a tile, with a bit for each block of pixels that it may reach.

Three passes, each on all threads: parts of the Gaussians find their entries; the same parts put these to
their tiles; tiles sort theirs by depth. What comes out does not depend on the number of parts.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

from typing import Annotated, Any, NamedTuple

import numba
import numpy as np

from ..simd import (
    LANES,
    added_in_fours,
    as_float,
    floor,
    lanes,
    largest,
    least,
    maximum,
    minimum,
    narrow,
    splat,
    square_root,
    stack,
    store,
    traced,
    where_greater,
)
from ..threads import on_threads, take
from .layout import Floats, jit

_Ints = np.ndarray[Any, np.dtype[np.int32]]
SLOTS = 16
"""Numbers of a splat: a vector, though 16 are used."""
SIDE = 16
"""Pixels of a tile's side: 16 blocks of 4 x 4, one bit of an integer each."""
# Why there is nothing to draw: places in `Tiles.skipped`.
FAINT = 0  # alpha stays below MIN_ALPHA
BEHIND = 1  # the camera
OUTSIDE = 2  # the image
INVALID = 3  # not finite, or too large
_ZERO = np.float32(0)  # a float32, as what it is compared with
_VECTOR = LANES
_ENTRIES_PER_GAUSSIAN = 4
"""Tiles that a Gaussian reaches, about, in the first try; by eye."""
_SPARE_ENTRIES = 1024
"""Room beside it for views of few Gaussians; by eye."""
_PARTS_PER_THREAD = 4
"""Parts of the Gaussians for each thread: some parts are in view and others are not; by eye."""
_MIN_PART = 4096
"""Gaussians of a part, at least: each counts its entries in all tiles; by eye."""
_KEY_BITS = 22
"""Bits of the depth's range that entries are sorted by."""
_DIGIT_BITS = 8
"""Bits that one pass of the sort looks at: a tile has some hundred entries."""
_DIGITS = 1 << _DIGIT_BITS
"""Values of a digit."""
_PASSES = -(-_KEY_BITS // _DIGIT_BITS)
"""Passes of the sort."""
_RECORD = 4
"""Numbers of an entry before it is sorted: depth, Gaussian, slot, blocks."""


class Tiles(NamedTuple):
    """Gaussians as a camera sees them, and the entries of those that are seen: sorted by tile, then by depth.
    int32.

    Slots number entries Gaussian by Gaussian. Depths closer than 2^-20 of what is seen keep their order.
    """

    splats: Floats
    total: int
    """Gaussians, seen or not."""
    width: int
    height: int
    start: Annotated[_Ints, "tiles+1"]
    """Start of each tile."""
    ids: _Ints
    """Gaussian of each entry."""
    slots: _Ints
    blocks: _Ints
    """Bits of the blocks of pixels that each entry may reach."""
    first_slot: Annotated[_Ints, "N+1+LANES"]
    """Start of the slots of each Gaussian."""
    skipped: _Ints
    """Counts of Gaussians that were left out as FAINT, BEHIND, OUTSIDE, INVALID."""


@traced
def _bands(splats_in, o, row, height, width, rows):
    """First and last column of blocks that a Gaussian may reach in so many rows of blocks, 4 or LANES; 1e9 and
    -1 where there is none.

    Between the pixel centres of a row of blocks the ellipse is widest at its right and left end or where
    these are cut off.
    """
    # Rows of pixels of each row of blocks, cut to the ellipse, relative to its middle.
    mx, my, rx, ry, slope, part, inverse_yy, right = (
        narrow(splats_in[o + k], rows) for k in (0, 1, 10, 11, 12, 13, 14, 15)
    )
    mx = mx - 0.5
    my = my - 0.5
    y = narrow(as_float(row) * 4 + lanes(splats_in, range(0, 4 * LANES, 4)), rows)
    above = maximum(y, maximum(-floor(ry - my), 0)) - my
    below = minimum(y + 3, minimum(floor(my + ry), narrow(as_float(height), rows) - 1)) - my
    # Where the ellipse is widest between them, and how far it reaches there.
    end = minimum(maximum(right, above), below)
    begin = minimum(maximum(-right, above), below)
    reach = ry * ry * inverse_yy
    far = mx + slope * end + square_root(maximum(part * (reach - end * end * inverse_yy), 0))
    near = mx + slope * begin - square_root(maximum(part * (reach - begin * begin * inverse_yy), 0))
    first = maximum(-floor(-maximum(near, mx - rx)), 0)
    last = minimum(floor(minimum(far, mx + rx)), narrow(as_float(width), rows) - 1)
    none = splat(mx, 0, rows)
    reached = where_greater(above, below, none, where_greater(first, last, none, 1))
    first = where_greater(reached, 0, floor(first * 0.25), 1e9)
    return first, where_greater(reached, 0, floor(last * 0.25), -1)


@traced
def _masks(first, last, column, memory):
    """Of the tiles in a column, four or one, the bits of the blocks that a Gaussian reaches, to memory[0, 4, 8,
    12].
    """
    rows = first.lanes
    c = narrow(as_float(column) * 4, rows)
    none = splat(first, 0, rows)
    bits = none
    for k in range(4):
        bits = bits + where_greater(first, c + k, none, where_greater(c + k, last, none, 2**k))
    places = narrow(lanes(first, [16 ** (lane % 4) for lane in range(LANES)]), rows)
    store(memory, 0, added_in_fours(bits * places))


@jit
def _find(
    counters, splats_in, bits, count, size, width, height, begins, first_slot, depth, tile_of, blocks_of, fill, skipped, found
):  # fmt: skip
    """The entries of parts of `size` Gaussians, from `begins` of each part on, as far as there is room.

    Per part: entries of each tile to `fill`, what was left out to `skipped`; how many entries there are, and
    the range of their depths, to `found`. Slots are counted from the part's first one.
    """
    across = (width + SIDE - 1) // SIDE
    memory = stack(_VECTOR)
    while True:
        part = take(counters, 0)
        if part >= len(found):
            break
        entries = 0
        base = begins[part]
        room = begins[part + 1] - base
        low = 0x7FFFFFFF
        high = 0
        for i in range(part * size, min(count, (part + 1) * size)):
            first_slot[i] = entries
            o = i * SLOTS
            if not splats_in[o + 10] > _ZERO:
                skipped[part, int(-splats_in[o + 10])] += 1
                continue
            # Four rows of tiles at a time: the range of blocks in each row, then the tiles of each column.
            before = entries
            top = splats_in[o + 1] - splats_in[o + 11]
            bottom = splats_in[o + 1] + splats_in[o + 11]
            r0 = int(top) // SIDE if top > _ZERO else 0
            r1 = int(bottom) // SIDE if bottom < height else (height - 1) // SIDE
            for r in range(r0, r1 + 1, 4):
                small = r == r1  # as most are: one row of tiles
                if small:
                    first_one, last_one = _bands(splats_in, o, 4 * r, height, width, 4)
                    begin = least(first_one)
                    end = largest(last_one)
                else:
                    first, last = _bands(splats_in, o, 4 * r, height, width, LANES)
                    begin = least(first)
                    end = largest(last)
                if begin > end:
                    continue
                for c in range(int(begin) // 4, int(end) // 4 + 1):
                    if small:
                        _masks(first_one, last_one, c, memory)
                    else:
                        _masks(first, last, c, memory)
                    for k in range(min(4, r1 + 1 - r)):
                        mask = int(memory[4 * k])
                        if mask != 0:
                            if entries < room:
                                tile = (r + k) * across + c
                                tile_of[base + entries] = tile
                                blocks_of[base + entries] = mask
                                fill[part, tile] += 1
                            entries += 1
            if entries > before:
                k = bits[o + 9]  # positive floats sort as their bits do
                low = k if k < low else low
                high = k if k > high else high
                depth[i] = k
            else:
                skipped[part, OUTSIDE] += 1
        found[part, 0] = entries
        found[part, 1] = low
        found[part, 2] = high


@jit
def _begin_tiles(fill, start):
    """Counts of each part and tile to the place of their first entry, which `start` has of each tile."""
    at = 0
    for tile in range(fill.shape[1]):
        start[tile] = at
        for part in range(fill.shape[0]):
            many = fill[part, tile]
            fill[part, tile] = at
            at += many
    start[fill.shape[1]] = at


@jit
def _place(
    counters, count, size, begins, found, low, shift, first_slot, depth, tile_of, blocks_of, fill, records
):
    """Entries to their tiles, in the order of the Gaussians; slots are counted from the first of all."""
    while True:
        part = take(counters, 0)
        if part >= len(found):
            break
        slots = 0
        for before in range(part):
            slots += found[before, 0]
        last = min(count, (part + 1) * size)
        for i in range(part * size, last):
            begin = first_slot[i]
            end = first_slot[i + 1] if i + 1 < last else found[part, 0]
            first_slot[i] = slots + begin
            for slot in range(begin, end):
                tile = tile_of[begins[part] + slot]
                at = fill[part, tile]
                fill[part, tile] = at + 1
                records[at, 0] = (depth[i] - low) >> shift
                records[at, 1] = i
                records[at, 2] = slots + slot
                records[at, 3] = blocks_of[begins[part] + slot]


@jit
def _sort(counters, start, most, records, ids, slots, blocks):
    """Radix sort of each tile's entries by depth, of at most `most`; equal ones keep their order."""
    # A key: the depth's digits, and below them the place among the tile's entries.
    keys = np.empty((2, most), np.int64)
    digits = np.empty((_PASSES, _DIGITS), np.int32)
    while True:
        tile = take(counters, 0)
        if tile >= len(start) - 1:
            break
        begin = start[tile]
        many = start[tile + 1] - begin
        if many == 0:
            continue
        # How often each digit occurs gives where those of each begin.
        digits[:] = 0
        for k in range(many):
            key = np.int64(records[begin + k, 0])
            keys[0, k] = key << 32 | k
            for turn in range(_PASSES):
                digits[turn, key >> turn * _DIGIT_BITS & _DIGITS - 1] += 1
        now = 0
        for turn in range(_PASSES):
            places = 32 + turn * _DIGIT_BITS
            if digits[turn, keys[now, 0] >> places & _DIGITS - 1] == many:  # all alike
                continue
            at = 0
            for d in range(_DIGITS):
                each = digits[turn, d]
                digits[turn, d] = at
                at += each
            for k in range(many):
                key = keys[now, k]
                d = key >> places & _DIGITS - 1
                keys[1 - now, digits[turn, d]] = key
                digits[turn, d] += 1
            now = 1 - now
        for k in range(many):
            at = begin + (keys[now, k] & 0xFFFFFFFF)
            ids[begin + k] = records[at, 1]
            slots[begin + k] = records[at, 2]
            blocks[begin + k] = records[at, 3]


def tiles_of(splats: Floats, count: int, width: int, height: int) -> Tiles:
    """Sort the first `count` Gaussians of `splats` into the tiles of an image."""
    tiles = ((width + SIDE - 1) // SIDE) * ((height + SIDE - 1) // SIDE)
    parts = max(1, min(_PARTS_PER_THREAD * numba.get_num_threads(), count // _MIN_PART))
    size = -(-count // parts)
    rooms = np.full(parts, _ENTRIES_PER_GAUSSIAN * size + _SPARE_ENTRIES)
    first_slot = np.empty(count + 1 + LANES, np.int32)
    depth = np.empty(count, np.int32)
    while True:
        # How many entries there are is known when all have been found: where room is too small, once more
        # with enough.
        begins = np.concatenate([[0], np.cumsum(rooms)])
        tile_of, blocks_of = np.empty((2, begins[-1]), np.int32)
        fill = np.zeros((parts, tiles), np.int32)
        skipped = np.zeros((parts, 4), np.int32)
        found = np.zeros((parts, 3), np.int64)
        on_threads(
            _find, splats, splats.view(np.int32), count, size, width, height,
            begins, first_slot, depth, tile_of, blocks_of, fill, skipped, found,
        )  # fmt: skip
        if (found[:, 0] <= rooms).all():
            break
        rooms = found[:, 0]
    entries = int(found[:, 0].sum())
    start = np.empty(tiles + 1, np.int32)
    _begin_tiles(fill, start)
    low = int(found[:, 1].min())
    shift = max(0, (int(found[:, 2].max()) - low).bit_length() - _KEY_BITS)
    records = np.empty((entries, _RECORD), np.int32)
    on_threads(
        _place, count, size, begins, found, low, shift, first_slot, depth, tile_of, blocks_of, fill, records
    )
    first_slot[count:] = entries
    ids, slots, blocks = np.empty((3, entries), np.int32)
    on_threads(_sort, start, int(np.diff(start).max()), records, ids, slots, blocks)
    return Tiles(splats, count, width, height, start, ids, slots, blocks, first_slot, skipped.sum(0))
