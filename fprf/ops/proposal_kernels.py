"""The compiled loops behind `proposal`: what happens along one ray stays in the cache.

Arrays are flat, contiguous float32, rays side by side. `warp` holds 1 where distances are those of a
contraction, 1 where points are contracted, and what else is subtracted from points and multiplied on each
axis (`rendering.space`).
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
_ONE = np.float32(1)
_TWO = np.float32(2)
_HALF = np.float32(0.5)


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
        t[k] = _TWO * g if g < _HALF else _HALF / min(c, _HALF)


@numba.njit(inline="always")
def _located(origin, direction, ray, t, first, count, warp, out, to):
    """Middles of `count` steps in the unit cube (`Space.locate`), to out[to :]."""
    for k in range(count):
        middle = _HALF * (t[first + k] + t[first + k + 1])
        at = to + 3 * k
        x = origin[3 * ray] + direction[3 * ray] * middle
        y = origin[3 * ray + 1] + direction[3 * ray + 1] * middle
        z = origin[3 * ray + 2] + direction[3 * ray + 2] * middle
        if warp[1] == _ONE:
            m = max(max(abs(x), abs(y)), max(abs(z), _ONE))
            factor = _ONE - _HALF / m
            out[at] = factor * (x / m)
            out[at + 1] = factor * (y / m)
            out[at + 2] = factor * (z / m)
        else:
            out[at] = (x - warp[2]) * warp[5] - warp[8]
            out[at + 1] = (y - warp[3]) * warp[6] - warp[9]
            out[at + 2] = (z - warp[4]) * warp[7] - warp[10]


@traced
def projected(table, weight, a, b, c, step, stride, u, v, w, channels):
    """The product of the samples of three planes at one point, times a weight for each channel, summed."""
    shares = [narrow(share, NARROW) for share in (u, v, w)]

    def add(k, sums):
        x, y, z = samples_of(table, (a + k, b + k, c + k), step, stride, shares)
        return [sums[0] + x * y * z * load(weight, k, NARROW)]

    (found,) = repeat(channels, [splat(table, 0.0, NARROW)], add, by=NARROW)
    return total(found)


@traced
def transmitted(depth, at, count):
    """depth[at :] = exp(-depth[at :]) for `count` numbers, whole vectors; 0 beyond exp(-87)."""

    def step(k, held):
        raw = maximum(splat(depth, LEAST_EXPONENT, WIDE), -load(depth, at + k, WIDE))
        store(depth, at + k, exp2(raw * LOG2_E) + raw * 0.0)
        return held

    repeat(count, [splat(depth, 0.0, WIDE)], step, by=WIDE)


@numba.njit(inline="always")
def _resampled(s, first, w, steps, padding, count, shift, out, to):
    """`stepfun.resample` of one ray: walks the steps and the wanted shares side by side."""
    extra = padding / np.float32(steps)
    whole = 0.0
    for k in range(steps):
        whole += w[k] + extra
    if not (whole > 0.0):  # NaN stays to be seen
        out[to : to + count + 1] = np.float32(np.nan)
        return
    step = 1.0 / (count + 1)
    here = 0
    low = 0.0
    high = float(w[0] + extra)
    for k in range(count + 1):
        wanted = (k + shift) * step * whole
        while high <= wanted and here < steps - 1:
            here += 1
            low = high
            high += w[here] + extra
        share = (wanted - low) / (high - low)
        left = s[first + here]
        right = s[first + here + 1]
        out[to + k] = left + np.float32(min(max(share, 0.0), 1.0)) * (right - left)


@_jit
def propose(origin, direction, near, far, s, warp, table, size, channels, weight, limit, padding, shift, out):
    """New edges out [R count+1] at even steps of the rendering weights of planes along edges s [R E].

    Density is exp(min(feature . weight - 1, limit)). shift [R] moves each ray's steps by a share of one.
    """
    rays = len(near)
    edges = len(s) // rays
    count = len(out) // rays - 1
    steps = edges - 1
    room = (edges + WIDE - 1) // WIDE * WIDE + STRETCH
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        t = np.empty(edges, np.float32)
        points = np.empty(3 * STRETCH, np.float32)
        corner = np.empty(3 * BLOCK, np.int64)
        part = np.empty(3 * BLOCK, np.float32)
        density = np.empty(room, np.float32)
        light = np.empty(room, np.float32)
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            _distances(s, ray * edges, edges, near[ray], far[ray], warp, t)
            depth = 0.0
            light[0] = _ZERO
            density[:] = _ZERO
            for first in range(0, steps, STRETCH):
                some = min(STRETCH, steps - first)
                if depth <= _BLACK or depth != depth:
                    _located(origin, direction, ray, t, first, some, warp, points, 0)
                    cells(points, 0, some, size, 0, channels, corner, part)
                    for k in range(some):
                        density[first + k] = projected(
                            table,
                            weight,
                            corner[k],
                            corner[BLOCK + k],
                            corner[2 * BLOCK + k],
                            channels,
                            size * channels,
                            part[k],
                            part[BLOCK + k],
                            part[2 * BLOCK + k],
                            channels,
                        )
                    exponential(density, first, limit, STRETCH)
                    for k in range(first, first + some):
                        depth += density[k] * (t[k + 1] - t[k])
                        light[k + 1] = np.float32(depth)
                else:
                    for k in range(first, first + some):
                        light[k + 1] = np.float32(depth)
            light[edges:] = _ZERO
            transmitted(light, 0, room - STRETCH)
            for k in range(steps):
                density[k] = light[k] - light[k + 1]
            _resampled(s, ray * edges, density, steps, padding, count, shift[ray], out, ray * (count + 1))


@_jit
def place(origin, direction, t, warp, out):
    """Middles [R S 3] of the steps between edges t [R E], in the unit cube."""
    rays = len(origin) // 3
    edges = len(t) // rays
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            to = 3 * ray * (edges - 1)
            _located(origin, direction, ray, t, ray * edges, edges - 1, warp, out, to)
