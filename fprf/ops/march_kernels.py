"""The compiled loops behind `march`: what happens along one ray stays in the cache.

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
def _padded(count):
    return (count + WIDE - 1) // WIDE * WIDE


@numba.njit(inline="always", cache=True)
def _weights(tau, before, w, samples):
    """w = exp(-before) (1 - exp(-tau)); arrays padded to whole vectors. Returns the optical depth of the ray."""
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
    return np.float32(total)


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
    samples, room = edges - 1, _padded(edges - 1)
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        t, point, feature = np.empty(edges, np.float32), np.empty(3 * STRETCH, np.float32), np.empty(channels, np.float32)
        corner, part = np.empty(3 * BLOCK, np.int64), np.empty(3 * BLOCK, np.float32)
        tau, before, w = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            _distances(s, ray * edges, edges, near[ray], far[ray], warp, t, 0)
            depth = _0
            for first in range(0, samples, STRETCH):
                some = min(STRETCH, samples - first)
                if depth > BLACK:
                    for k in range(first, samples):
                        tau[k] = _0
                    break
                _locate(origin, direction, ray, t, first, some, warp, point, 0, 1, STRETCH)
                cells(point, 0, some, 1, STRETCH, size, 0, channels, corner, part)
                for k in range(some):
                    a, b, c = corner[k], corner[BLOCK + k], corner[2 * BLOCK + k]
                    u, v, x = part[k], part[BLOCK + k], part[2 * BLOCK + k]
                    for g in range(0, channels, NARROW):
                        product_forward(table, feature, a + g, b + g, c + g, g, channels, size * channels, u, v, x, NARROW)
                    tau[first + k] = min(dot(feature, 0, weight, 0, channels) - _1, limit)
                for k in range(first, min(room, first + STRETCH), WIDE):
                    store(tau, k, exp(load(tau, k, WIDE)))
                for k in range(first, first + some):
                    tau[k] *= t[k + 1] - t[k]
                    depth += tau[k]
            _weights(tau, before, w, samples)
            _resample(s, ray * edges, w, samples, padding, count, shift[ray], out, ray * (count + 1))


@_jit
def distances(s, near, far, warp, t):
    """Ray parameters t [R E] of edges s [R E]."""
    rays = len(near)
    edges = len(s) // rays
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            _distances(s, ray * edges, edges, near[ray], far[ray], warp, t, ray * edges)


@_jit
def place(origin, direction, t, warp, point):
    """Middles [R S 3] of the steps between edges t [R E], in the unit cube."""
    rays = len(origin) // 3
    edges = len(t) // rays
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            _locate(origin, direction, ray, t, ray * edges, edges - 1, warp, point, ray * (edges - 1) * 3, 3, 1)


@numba.njit(inline="always", cache=True)
def _heaviest(w, samples, budget, order, keep, to):
    """`stepfun.keep_heaviest` of one ray; returns how many are kept."""
    light, kept = 0, 0
    for k in range(samples):
        # A sample above the budget stays whatever the others are; a NaN stays to be seen.
        keep[to + k] = not (w[k] <= budget)
        if keep[to + k]:
            kept += 1
            continue
        at = light
        while at > 0 and w[order[at - 1]] > w[k]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
        light += 1
    dropped = _0
    for k in range(light):
        dropped += w[order[k]]
        if not (dropped <= budget):
            keep[to + order[k]] = True
            kept += 1
    return kept


@_jit
def weigh(density, t, budget, weights, depth, opacity, transmittance, keep, kept):
    """Weights [R S] of densities between edges, expected distance, opacity and its complement; which samples to keep."""
    rays = len(depth)
    samples = len(density) // rays
    room = _padded(samples)
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        tau, before, w = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
        order = np.empty(samples, np.int64)
        first = task * RAYS
        last = min(rays, first + RAYS)
        optical = np.zeros(_padded(RAYS), np.float32)
        for ray in range(first, last):
            edge = ray * (samples + 1)
            for k in range(samples):
                tau[k] = density[ray * samples + k] * (t[edge + k + 1] - t[edge + k])
            optical[ray - first] = _weights(tau, before, w, samples)
            total, mean = _0, _0
            for k in range(samples):
                weights[ray * samples + k] = w[k]
                total += w[k]
                mean += w[k] * (_HALF * (t[edge + k] + t[edge + k + 1]))
            depth[ray] = mean / max(total, np.float32(1e-10))
            kept[ray] = _heaviest(w, samples, budget, order, keep, ray * samples)
        clear, solid = np.empty(len(optical), np.float32), np.empty(len(optical), np.float32)
        for k in range(0, len(optical), WIDE):
            store(solid, k, opaque(load(optical, k, WIDE)))
        for k in range(len(optical)):
            optical[k] = -optical[k]
        for k in range(0, len(optical), WIDE):
            store(clear, k, exp(load(optical, k, WIDE)))
        for ray in range(first, last):
            opacity[ray], transmittance[ray] = solid[ray - first], clear[ray - first]


@_jit
def gather(keep, start, weights, point, latent, view, kept_ray, kept_weight, kept_point, kept_latent, kept_view):
    """The kept samples of all rays one after the other; start [R] = where each ray's begin."""
    rays = len(start)
    samples, width = len(weights) // rays, len(latent) // len(weights)
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            at = start[ray]
            for k in range(ray * samples, (ray + 1) * samples):
                if not keep[k]:
                    continue
                kept_ray[at], kept_weight[at] = ray, weights[k]
                for axis in range(3):
                    kept_point[3 * at + axis] = point[3 * k + axis]
                    kept_view[3 * at + axis] = view[3 * ray + axis]
                if width % WIDE == 0:
                    for c in range(0, width, WIDE):
                        store(kept_latent, width * at + c, load(latent, width * k + c, WIDE))
                else:
                    for c in range(width):
                        kept_latent[width * at + c] = latent[width * k + c]
                at += 1


@_jit
def composite(weight, values, start, out):
    """out [R C] = sum of weight * values over the samples start[r] to start[r + 1] of each ray."""
    rays = len(start) - 1
    width = len(out) // rays
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        sums = np.empty(width, np.float32)
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            sums[:] = _0
            for k in range(start[ray], start[ray + 1]):
                value, w = values[width * k : width * (k + 1)], weight[k]
                for c in range(width):
                    sums[c] += w * value[c]
            out[width * ray : width * (ray + 1)] = sums
