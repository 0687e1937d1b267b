"""The compiled loops behind `march_gradients`: each ray by itself. Arrays are flat, contiguous float32, rays side by side."""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import numba
import numpy as np

from .exponential import exp_lanes
from .lanes import WIDE
from .march_kernels import RAYS
from .rows import copy_lanes

__all__ = ["composite", "composite_back", "spread", "weigh_back"]

_jit = numba.njit(parallel=True, cache=True, nogil=True)
_0 = np.float32(0)


@_jit
def weigh_back(density, t, fair, weights, through, g_weights, g_through, out):
    """out [R S] = fair times the gradient of the densities, from those of the weights and of what passes through.

    dL/dtau_i = T_i+1 g_i - sum_j>i w_j g_j - T g_T, T_i+1 what passes step i. What is empty counts as 1 (fair) or 0.
    """
    rays = len(through)
    samples = len(density) // rays
    room = (samples + WIDE - 1) // WIDE * WIDE
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        after = np.zeros(room, np.float32)
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            first, edge, total = ray * samples, ray * (samples + 1), 0.0
            for k in range(samples):
                total += density[first + k] * (t[edge + k + 1] - t[edge + k])
                after[k] = np.float32(-total)
            for k in range(0, room, WIDE):
                exp_lanes(after, k, after, k)
            behind = float(through[ray] * g_through[ray]) if len(g_through) > 0 else 0.0
            for back in range(samples):
                k = samples - 1 - back
                g = g_weights[first + k] if len(g_weights) > 0 else _0
                slope = np.float32(after[k] * g - behind) * (t[edge + k + 1] - t[edge + k])
                out[first + k] = slope * fair[first + k] if len(fair) > 0 else slope
                behind += weights[first + k] * g


@_jit
def spread(keep, start, values, out):
    """The rows of kept samples back in their places [R S, width], zeros elsewhere: the opposite of `gather`."""
    rays = len(start)
    samples, width = len(keep) // rays, len(out) // len(keep)
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            at = start[ray]
            for k in range(ray * samples, (ray + 1) * samples):
                if not keep[k]:
                    out[width * k : width * (k + 1)] = _0
                    continue
                if width % WIDE == 0:
                    for c in range(0, width, WIDE):
                        copy_lanes(values, width * at + c, out, width * k + c)
                else:
                    for c in range(width):
                        out[width * k + c] = values[width * at + c]
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


@_jit
def composite_back(weight, values, start, grad, g_weight, g_values):
    """Gradients of the weights and of the values of `composite`; what is empty is not wanted."""
    rays = len(start) - 1
    width = len(grad) // rays
    for task in numba.prange((rays + RAYS - 1) // RAYS):
        for ray in range(task * RAYS, min(rays, task * RAYS + RAYS)):
            g = grad[width * ray : width * (ray + 1)]
            for k in range(start[ray], start[ray + 1]):
                if len(g_values) > 0:
                    moved, w = g_values[width * k : width * (k + 1)], weight[k]
                    for c in range(width):
                        moved[c] = w * g[c]
                if len(g_weight) > 0:
                    value, total = values[width * k : width * (k + 1)], _0
                    for c in range(width):
                        total += value[c] * g[c]
                    g_weight[k] = total
