"""The compiled loops behind `proposal`: what happens along one ray stays in the cache.

Arrays are flat, contiguous float32, rays side by side. `warp` holds 1 where distances are those of a
contraction, 1 where points are contracted, and for others what is subtracted from points and multiplied on
each axis, and then subtracted (`rendering.space`).
"""

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
    narrow,
    repeat,
    splat,
    store,
    total,
    traced,
)
from .threads import cached_jit
from .triplane_kernels import LEAST_EXPONENT, LOG2_E, cells, exponential, samples_of

_jit = cached_jit(parallel=True, nogil=True)
RAYS = 16
"""Rays of a task."""
STRETCH = 16
"""Steps of a ray that are looked up before it is asked whether anything behind them can be seen."""
_BLACK = 20.0
"""Optical depth behind which nothing is looked up: exp(-20) = 2e-9 of the light is left."""
_ZERO = np.float32(0)
"""In float32, as all numbers of these loops."""
_ONE = np.float32(1)
"""In float32."""
_HALF = np.float32(0.5)
"""In float32."""
COLUMNS = 9
"""Numbers of a ray: origin, direction, near, far, shift of new edges."""


@numba.njit(inline="always")
def _distances(s, first, edges, near, far, warp, t):
    """`Space.distance` of one ray."""
    if warp[0] != _ONE:
        for k in range(edges):
            t[k] = near + (far - near) * s[first + k]
        return
    g_near = _HALF * near if near < _ONE else _ONE - _HALF / near
    g_far = _HALF * far if far < _ONE else _ONE - _HALF / far
    c_near = _ONE - _HALF * near if near < _ONE else _HALF / near
    c_far = _ONE - _HALF * far if far < _ONE else _HALF / far
    for k in range(edges):
        g = g_near + (g_far - g_near) * s[first + k]
        c = c_far + (c_near - c_far) * (_ONE - s[first + k])
        t[k] = g + g if g < _HALF else _HALF / min(c, _HALF)


@numba.njit(inline="always")
def _located(rays, at, t, first, count, warp, out):
    """Middles of `count` steps of the ray at rays[at] in the unit cube (`Space.locate`)."""
    for k in range(count):
        middle = _HALF * (t[first + k] + t[first + k + 1])
        x = rays[at] + rays[at + 3] * middle
        y = rays[at + 1] + rays[at + 4] * middle
        z = rays[at + 2] + rays[at + 5] * middle
        if warp[1] == _ONE:
            m = max(max(abs(x), abs(y)), max(abs(z), _ONE))
            factor = _ONE - _HALF / m
            out[3 * k] = factor * (x / m)
            out[3 * k + 1] = factor * (y / m)
            out[3 * k + 2] = factor * (z / m)
        else:
            out[3 * k] = (x - warp[2]) * warp[5] - warp[8]
            out[3 * k + 1] = (y - warp[3]) * warp[6] - warp[8]
            out[3 * k + 2] = (z - warp[4]) * warp[7] - warp[8]


@traced
def projected(table, weight, corners, steps, shares, channels):
    """The product of the samples of three planes at one point, times a weight for each channel, summed.

    `corners` are the first numbers of the lower corners, `steps` lead to the next node across and down.
    """
    apart = [narrow(share, NARROW) for share in shares]

    def add(k, sums):
        x, y, z = samples_of(table, [corner + k for corner in corners], *steps, apart)
        return [sums[0] + x * y * z * load(weight, k, NARROW)]

    (found,) = repeat(channels, [splat(table, 0.0, NARROW)], add, by=NARROW)
    return total(found)


@traced
def transmitted(depth, count):
    """depth = exp(-depth) for `count` numbers, whole vectors; 0 beyond exp(-87)."""

    def step(k, held):
        raw = maximum(splat(depth, LEAST_EXPONENT, WIDE), -load(depth, k, WIDE))
        store(depth, k, exp2(raw * LOG2_E) + raw * 0.0)
        return held

    repeat(count, [splat(depth, 0.0, WIDE)], step, by=WIDE)


@numba.njit(inline="always")
def _resampled(s, w, padding, shift, out):
    """`stepfun.resample` of one ray: walks the steps and the wanted shares side by side."""
    steps = len(s) - 1
    extra = padding / np.float32(steps)
    whole = 0.0
    for k in range(steps):
        whole += w[k] + extra
    if not (whole > 0.0):  # NaN stays to be seen
        out[:] = np.float32(np.nan)
        return
    step = 1.0 / len(out)
    here = 0
    low = 0.0
    high = float(w[0] + extra)
    for k in range(len(out)):
        wanted = (k + shift) * step * whole
        while high <= wanted and here < steps - 1:
            here += 1
            low = high
            high += w[here] + extra
        share = (wanted - low) / (high - low)
        left = s[here]
        out[k] = left + np.float32(min(max(share, 0.0), 1.0)) * (s[here + 1] - left)


@_jit
def propose(rays, s, warp, table, size, weight, out):
    """New edges out [R count+1] at even steps of the rendering weights of planes along edges s [R E].

    Density is exp(min(feature . weight - 1, limit)); `limit` and the padding stand behind the other numbers of
    `warp`. The shift of a ray moves its steps by a share of one.
    """
    channels = len(weight)
    count = len(rays) // COLUMNS
    edges = len(s) // count
    wanted = len(out) // count
    limit = warp[9]
    steps = edges - 1
    room = (edges + WIDE - 1) // WIDE * WIDE
    for task in numba.prange((count + RAYS - 1) // RAYS):
        t = np.empty(edges, np.float32)
        points = np.empty(3 * STRETCH, np.float32)
        corner = np.empty(3 * BLOCK, np.int64)
        part = np.empty(3 * BLOCK, np.float32)
        density = np.empty(room + STRETCH, np.float32)
        depths = np.empty(room, np.float32)
        for ray in range(task * RAYS, min(count, task * RAYS + RAYS)):
            at = ray * COLUMNS
            _distances(s, ray * edges, edges, rays[at + 6], rays[at + 7], warp, t)
            depth = 0.0
            depths[:] = _ZERO
            density[:] = _ZERO
            for first in range(0, steps, STRETCH):
                some = min(STRETCH, steps - first)
                if depth <= _BLACK:
                    _located(rays, at, t, first, some, warp, points)
                    cells(points, 0, some, size, 0, channels, corner, part)
                    for k in range(some):
                        corners = (corner[k], corner[BLOCK + k], corner[2 * BLOCK + k])
                        shares = (part[k], part[BLOCK + k], part[2 * BLOCK + k])
                        apart = (channels, size * channels)
                        density[first + k] = projected(table, weight, corners, apart, shares, channels)
                    exponential(density, first, limit, STRETCH)
                    for k in range(first, first + some):
                        depth += density[k] * (t[k + 1] - t[k])
                        depths[k + 1] = np.float32(depth)
                else:
                    depths[first + 1 : first + some + 1] = np.float32(depth)
            transmitted(depths, room)
            for k in range(steps):
                density[k] = depths[k] - depths[k + 1]
            here = s[ray * edges : (ray + 1) * edges]
            goal = out[ray * wanted : (ray + 1) * wanted]
            _resampled(here, density, warp[10], rays[at + 8], goal)


@_jit
def place(rays, t, warp, out):
    """Middles [R S 3] of the steps between edges t [R E], in the unit cube."""
    count = len(rays) // COLUMNS
    edges = len(t) // count
    width = 3 * (edges - 1)
    for task in numba.prange((count + RAYS - 1) // RAYS):
        for ray in range(task * RAYS, min(count, task * RAYS + RAYS)):
            goal = out[ray * width : (ray + 1) * width]
            _located(rays, ray * COLUMNS, t, ray * edges, edges - 1, warp, goal)
