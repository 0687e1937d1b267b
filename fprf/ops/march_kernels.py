"""The compiled loop behind `march.propose`: what happens along one ray stays in the cache.

Arrays are flat, contiguous float32, rays side by side. `warp` holds 0 for a contraction, 1 for a box or 2 for the
distances of a contraction with points as they are, then what a box subtracts and multiplies on each axis (`rendering.space`).
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .simd import BLOCK, NARROW, WIDE, dot, exp, load, opaque, store
from .triplane_kernels import cells, product_forward

_jit = numba.njit(parallel=True, cache=True, nogil=True)

RAYS = 16
"""Rays of a task."""
STRETCH = 16
"""Samples of a ray that are looked up before it is asked whether anything behind them can be seen."""
BLACK = np.float32(20)
"""Optical depth behind which nothing is looked up: exp(-20) = 2e-9 of the light is left, a thirtieth of float32's rounding."""
_0, _1, _HALF, _2 = np.float32(0), np.float32(1), np.float32(0.5), np.float32(2)


@numba.njit(inline="always", cache=True)
def _distances(s, first, edges, near, far, warp, t, to):
    """`Space.distance` of one ray."""
    if warp[0] != _1:
        # g is linear in s up to 1; beyond, its complement c keeps the relative accuracy.
        g_near = _HALF * near if near < _1 else _1 - _HALF / near
        g_far = _HALF * far if far < _1 else _1 - _HALF / far
        c_near = _1 - _HALF * near if near < _1 else _HALF / near
        c_far = _1 - _HALF * far if far < _1 else _HALF / far
        for k in range(edges):
            g = g_near + (g_far - g_near) * s[first + k]
            c = c_far + (c_near - c_far) * (_1 - s[first + k])
            t[to + k] = _2 * g if g < _HALF else _HALF / min(c, _HALF)
    else:
        for k in range(edges):
            t[to + k] = near + (far - near) * s[first + k]


@numba.njit(inline="always", cache=True)
def _locate(origin, direction, ray, t, first, count, warp, out, to, apart, across):
    """Middles of `count` steps in the unit cube (`Space.locate`)."""
    # Axis by axis, which the compiler turns into vectors.
    for axis in range(3):
        o, d = origin[3 * ray + axis], direction[3 * ray + axis]
        for k in range(count):
            out[to + k * apart + axis * across] = o + d * (_HALF * (t[first + k] + t[first + k + 1]))
    if warp[0] == _0:
        for k in range(count):
            at = to + k * apart
            x, y, z = out[at], out[at + across], out[at + 2 * across]
            m = max(max(abs(x), abs(y)), max(abs(z), _1))
            f = _1 - _HALF / m
            out[at], out[at + across], out[at + 2 * across] = f * (x / m), f * (y / m), f * (z / m)
    elif warp[0] == _1:
        for axis in range(3):
            low, factor = warp[1 + axis], warp[4 + axis]
            for k in range(count):
                at = to + k * apart + axis * across
                out[at] = (out[at] - low) * factor - _1


@numba.njit(inline="always", cache=True)
def _weights(tau, before, w, samples):
    """w_i = exp(-sum_j<i tau_j) (1 - exp(-tau_i)) (paper, Eq. 2); arrays padded to whole vectors."""
    total = 0.0  # float64, so that the error does not grow with the number of samples
    for k in range(samples):
        before[k] = np.float32(-total)
        total += tau[k]
    for k in range(samples, len(before)):
        before[k], tau[k] = _0, _0
    for k in range(0, len(before), WIDE):
        store(before, k, exp(load(before, k, WIDE)))
        store(w, k, opaque(load(tau, k, WIDE)))
    for k in range(samples):
        w[k] *= before[k]


@numba.njit(inline="always", cache=True)
def _resample(s, first, w, samples, padding, count, shift, out, to):
    """`stepfun.resample` of one ray: walk transmittance the steps and the wanted shares side by side."""
    extra, total = padding / np.float32(samples), _0
    for k in range(samples):
        total += w[k] + extra
    step = _1 / np.float32(count + 1)
    here, low, high = 0, _0, w[0] + extra
    for k in range(count + 1):
        wanted = (np.float32(k) + shift) * step * total
        while high <= wanted and here < samples - 1:
            here += 1
            low = high
            high += w[here] + extra
        # A step without probability is never stayed in, but for the last; there any place is right.
        share = (wanted - low) / (high - low) if high > low else _0
        left, right = s[first + here], s[first + here + 1]
        out[to + k] = left + min(max(share, _0), _1) * (right - left)


@_jit
def propose(origin, direction, near, far, s, warp, table, size, channels, weight, limit, padding, shift, out):
    """New edges out [R count+1] at even steps of the rendering weights of a plane field along edges s [R E].

    The field's density is exp(min(feature . weight - 1, limit)). shift [R] moves each ray's steps by a share of one.
    """
    rays = len(near)
    edges, count = len(s) // rays, len(out) // rays - 1
    samples = edges - 1
    room = (samples + WIDE - 1) // WIDE * WIDE
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        t, point, feature = np.empty(edges, np.float32), np.empty(3 * STRETCH, np.float32), np.empty(channels, np.float32)
        corner, part = np.empty(3 * BLOCK, np.int64), np.empty(3 * BLOCK, np.float32)
        tau, before, w = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            # Distances of the edges first; then density, stretch by stretch, as long as light gets there.
            _distances(s, ray * edges, edges, near[ray], far[ray], warp, t, 0)
            depth = _0
            for first in range(0, samples, STRETCH):
                some = min(STRETCH, samples - first)
                if depth > BLACK:
                    for k in range(first, samples):
                        tau[k] = _0
                    break
                _locate(origin, direction, ray, t, first, some, warp, point, 0, 1, STRETCH)
                # The field at the middles: the product of three planes, and one linear map of it.
                cells(point, 0, some, 1, STRETCH, size, 0, channels, corner, part)
                for k in range(some):
                    a, b, c = corner[k], corner[BLOCK + k], corner[2 * BLOCK + k]
                    u, v, x = part[k], part[BLOCK + k], part[2 * BLOCK + k]
                    for g in range(0, channels, NARROW):
                        product_forward(table, feature, a + g, b + g, c + g, g, channels, size * channels, u, v, x, NARROW)
                    tau[first + k] = min(dot(feature, 0, weight, 0, channels) - _1, limit)
                # Density times length is optical depth.
                for k in range(first, min(room, first + STRETCH), WIDE):
                    store(tau, k, exp(load(tau, k, WIDE)))
                for k in range(first, first + some):
                    tau[k] *= t[k + 1] - t[k]
                    depth += tau[k]
            # The next edges lie where the weights are.
            _weights(tau, before, w, samples)
            _resample(s, ray * edges, w, samples, padding, count, shift[ray], out, ray * (count + 1))
