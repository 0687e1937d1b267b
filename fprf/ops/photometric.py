"""L1 and SSIM between two images with the gradient, compiled: the loss of 3D Gaussian splatting in under a millisecond.

Images are planes [3, H16, W16], flat, padded to multiples of LANES, with `slack(width)` numbers behind; SSIM is Wang's, in
windows of 11 x 11 (Gaussian, sigma 1.5) that lie inside the image, over colours in [0, 1].
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

import numba
import numpy as np

from .simd import LANES, absolute, lanes, load, splat, store, total, where_greater

__all__ = ["WINDOW", "blurred", "loss", "slack"]

WINDOW = 11
_weights = np.exp(-((np.arange(11.0) - 5) ** 2) / (2 * 1.5**2))
_WEIGHTS = (_weights / _weights.sum()).astype(np.float32)
_f = np.float32
_0, _1, _2 = _f(0), _f(1), _f(2)
_C1, _C2 = _f(0.01**2), _f(0.03**2)
_jit = numba.njit(parallel=True, cache=True, nogil=True, fastmath={"contract", "arcp", "nsz"})


def slack(padded_width: int) -> int:
    """Numbers behind the planes that the vectors may read."""
    return 64 + WINDOW * padded_width


@numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz"}, inline="never")
def _across(source, at, out, to, count):
    """out[to + x] = the weighted sum of source[at + x : at + x + 11]."""
    for x in range(0, count, LANES):
        found = load(source, at + x) * _WEIGHTS[0]
        for k in range(1, WINDOW):
            found = found + load(source, at + x + k) * _WEIGHTS[k]
        store(out, to + x, found)


@_jit
def blurred(image, width, height):
    """Windowed means of an image and of its squares, [2, planes]: the part of SSIM that a target has once for all."""
    padded = (width + LANES - 1) // LANES * LANES
    area = padded * ((height + LANES - 1) // LANES * LANES)
    out = np.zeros((2, 3 * area + 64), np.float32)
    for c in numba.prange(3):
        room = padded + 64
        line = np.zeros(2 * room, np.float32)
        for y in range(height - WINDOW + 1):
            at = c * area + y * padded
            for x in range(0, width, LANES):
                mean, square = splat(_0), splat(_0)
                for k in range(WINDOW):
                    v = load(image, at + x + k * padded)
                    mean = mean + v * _WEIGHTS[k]
                    square = square + v * v * _WEIGHTS[k]
                store(line, x, mean)
                store(line, room + x, square)
            _across(line, 0, out[0], at, width - WINDOW + 1)
            _across(line, room, out[1], at, width - WINDOW + 1)
    return out


@_jit
def loss(image, target, target_blurred, width, height, share):
    """Mean |image - target|, mean SSIM, and the gradient [planes] of (1 - share) L1 + share (1 - SSIM) in the image.

    Where the image is smaller than a window, SSIM counts as 0 and only L1 has a gradient.
    """
    padded = (width + LANES - 1) // LANES * LANES
    area = padded * ((height + LANES - 1) // LANES * LANES)
    across, down = width - WINDOW + 1, height - WINDOW + 1
    windows = max(across, 0) * max(down, 0)
    grad = np.zeros(3 * area + 64, np.float32)
    apart, alike = np.zeros(3, np.float64), np.zeros(3, np.float64)
    of_l1 = (_1 - share) / _f(3 * width * height)
    room = padded + 64
    for c in numba.prange(3):
        if share > 0 and windows > 0:
            scale = -share / _f(3 * windows)
            line, means = np.zeros(3 * room, np.float32), np.zeros(3 * room, np.float32)
            # What each window's mean of the image, of its square and of its product with the target must move by,
            # with 10 rows and columns of zeros before them.
            layer = (height + 10) * room
            moves = np.zeros(3 * layer, np.float32)
            summed = 0.0
            for y in range(down):
                at = c * area + y * padded
                for x in range(0, width, LANES):
                    p, q, r = splat(_0), splat(_0), splat(_0)
                    for k in range(WINDOW):
                        v = load(image, at + x + k * padded)
                        weighted = v * _WEIGHTS[k]
                        p = p + weighted
                        q = q + v * weighted
                        r = r + weighted * load(target, at + x + k * padded)
                    store(line, x, p)
                    store(line, room + x, q)
                    store(line, 2 * room + x, r)
                for part in range(3):
                    _across(line, part * room, means, part * room, across)
                kept = splat(_0)
                for x in range(0, across, LANES):
                    ma, aa, ab = load(means, x), load(means, room + x), load(means, 2 * room + x)
                    mb, bb = load(target_blurred[0], at + x), load(target_blurred[1], at + x)
                    n1, n2 = _2 * ma * mb + _C1, _2 * (ab - ma * mb) + _C2
                    i1, i2 = _1 / (ma * ma + mb * mb + _C1), _1 / (aa - ma * ma + bb - mb * mb + _C2)
                    both = i1 * i2
                    s = n1 * n2 * both
                    inside = where_greater(_f(across) - _f(x), lanes(), splat(_1), _0)
                    k = inside * scale
                    kept = kept + s * inside
                    d = (y + 10) * room + x + 10
                    store(moves, d, k * _2 * (mb * (n2 - n1) * both + s * ma * (i2 - i1)))
                    store(moves, layer + d, -k * s * i2)
                    store(moves, 2 * layer + d, k * _2 * n1 * both)
                summed += total(kept)
            alike[c] = summed
            for y in range(height):
                for part in range(3):
                    for x in range(0, width + 10, LANES):
                        o = part * layer + y * room + x
                        s = load(moves, o) * _WEIGHTS[0]
                        for k in range(1, WINDOW):
                            s = s + load(moves, o + k * room) * _WEIGHTS[k]
                        store(line, part * room + x, s)
                    _across(line, part * room, means, part * room, width)
                at = c * area + y * padded
                for x in range(0, width, LANES):
                    a, b = load(image, at + x), load(target, at + x)
                    store(grad, at + x, load(means, x) + _2 * a * load(means, room + x) + b * load(means, 2 * room + x))
        summed = 0.0
        for y in range(height):
            at = c * area + y * padded
            line_sum = splat(_0)
            for x in range(0, width, LANES):
                d = load(image, at + x) - load(target, at + x)
                inside = where_greater(_f(width) - _f(x), lanes(), splat(_1), _0)
                line_sum = line_sum + absolute(d) * inside
                slope = where_greater(d, _0, splat(of_l1), where_greater(_0, d, splat(-of_l1), _0))
                store(grad, at + x, (load(grad, at + x) + slope) * inside)
            summed += total(line_sum)
        apart[c] = summed
    return apart.sum() / (3 * width * height), alike.sum() / (3 * max(windows, 1)), grad
