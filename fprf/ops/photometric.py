"""L1 and SSIM between two images with the gradient, compiled: the loss of 3D Gaussian splatting in under a
millisecond.

Images are planes [3, H16, W16], flat, padded to multiples of LANES, with `slack(width)` numbers behind; SSIM
is Wang's, in windows of 11 x 11 (Gaussian, sigma 1.5) that lie inside the image, over colours in [0, 1].
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

from typing import Any

import numba
import numpy as np

from .simd import LANES, absolute, as_float, lanes, load, splat, store, total, traced, where_greater
from .threads import cached_jit, on_threads, take

Floats = np.ndarray[Any, np.dtype[np.float32]]
WINDOW = 11
"""Pixels of a window's side (Wang et al. 2004)."""
WINDOW_SIGMA = 1.5
"""Standard deviation of its weights in pixels (Wang et al. 2004)."""
SSIM_C1 = 0.01**2
"""Wang's C1 = (K1 L)^2, for colours with the range L = 1."""
SSIM_C2 = 0.03**2
"""Wang's C2 = (K2 L)^2."""
_weights = np.exp(-((np.arange(float(WINDOW)) - WINDOW // 2) ** 2) / (2 * WINDOW_SIGMA**2))
_WEIGHTS = (_weights / _weights.sum()).tolist()
_STRIP_ROWS = 48
"""Rows that a thread takes at a time; windows that begin above them are computed once more, a fifth. By
eye.
"""
_jit = cached_jit(nogil=True, fastmath={"contract", "arcp", "nsz"})


def slack(padded_width: int) -> int:
    """Numbers behind the planes that the vectors may read."""
    return 64 + WINDOW * padded_width


def _across(source, at):
    """Weighted sums of source[at + x : at + x + 11] for the x of a vector."""
    return _weighted(load(source, at + k) for k in range(WINDOW))


def _weighted(values):
    summed = None
    for weight, each in zip(_WEIGHTS, values, strict=True):
        summed = each * weight if summed is None else summed + each * weight
    return summed


@traced
def _down(image, at, padded, line, x, room):
    """Weighted sums of columns of the image and of its square."""
    rows = [load(image, at + k * padded) for k in range(WINDOW)]
    store(line, x, _weighted(rows))
    store(line, room + x, _weighted(v * v for v in rows))


@traced
def _finish_blurred(line, x, room, out, at, area):
    store(out, at, _across(line, x))
    store(out, area + at, _across(line, room + x))


@_jit
def _blurred(counters, image, width, height, lines, out):
    padded = (width + LANES - 1) // LANES * LANES
    area = padded * ((height + LANES - 1) // LANES * LANES)
    down = height - WINDOW + 1
    room = padded + 64
    line = lines[take(counters, 1)]
    while True:
        unit = take(counters, 0)
        if unit >= 3 * down:
            break
        at = unit // down * area + unit % down * padded
        for x in range(0, width, LANES):
            _down(image, at + x, padded, line, x, room)
        for x in range(0, width - WINDOW + 1, LANES):
            _finish_blurred(line, x, room, out, at + x, 3 * area + 64)


def blurred(image: Floats, width: int, height: int) -> Floats:
    """Windowed means of an image and of its squares, [2, planes]: the part of SSIM that a target has once for
    all.
    """
    padded = (width + LANES - 1) // LANES * LANES
    out = np.zeros((2, 3 * padded * ((height + LANES - 1) // LANES * LANES) + 64), np.float32)
    if min(width, height) >= WINDOW:
        lines = np.zeros((numba.get_num_threads(), 2 * (padded + 64)), np.float32)
        on_threads(_blurred, image, width, height, lines, out.reshape(-1))
    return out


@traced
def _down_both(image, target, at, padded, line, x, room):
    """Weighted sums of columns of the image, of its square and of its product with the target."""
    rows = [(load(image, at + k * padded), load(target, at + k * padded)) for k in range(WINDOW)]
    store(line, x, _weighted(v for v, _ in rows))
    store(line, room + x, _weighted(v * v for v, _ in rows))
    store(line, 2 * room + x, _weighted(v * w for v, w in rows))


@traced
def _similarity(line, x, room, blurred, at, beyond, across, scale, moves, d, layer):
    """SSIM of the windows from x on; and what each one's mean of the image, of its square and of its product
    with the target must move by, to moves.
    """
    # Means, squares and the product in the windows: (2 m_a m_b + c1)(2 v_ab + c2) / ((m_a^2 + m_b^2 + c1)(v_a
    # + v_b + c2)).
    ma = _across(line, x)
    aa = _across(line, room + x)
    ab = _across(line, 2 * room + x)
    mb = load(blurred, at)
    bb = load(blurred, beyond + at)
    n1 = 2 * ma * mb + SSIM_C1
    n2 = 2 * (ab - ma * mb) + SSIM_C2
    i1 = 1 / (ma * ma + mb * mb + SSIM_C1)
    i2 = 1 / (aa - ma * ma + bb - mb * mb + SSIM_C2)
    both = i1 * i2
    s = n1 * n2 * both
    inside = where_greater(as_float(across) - as_float(x), lanes(s), splat(s, 1), 0)
    k = inside * scale
    store(moves, d, k * 2 * (mb * (n2 - n1) * both + s * ma * (i2 - i1)))
    store(moves, layer + d, -k * s * i2)
    store(moves, 2 * layer + d, k * 2 * n1 * both)
    return s * inside


@traced
def _up(moves, o, room, line, x):
    store(line, x, _weighted(load(moves, o + k * room) for k in range(WINDOW)))


@traced
def _gradient(image, target, at, line, x, room, grad):
    value = (
        _across(line, x)
        + 2 * load(image, at) * _across(line, room + x)
        + load(target, at) * _across(line, 2 * room + x)
    )
    store(grad, at, value)


@traced
def _difference(image, target, at, width, x, slope, grad):
    """|image - target|; its slope is added to the gradient, which is 0 beyond the image."""
    d = load(image, at) - load(target, at)
    inside = where_greater(as_float(width) - as_float(x), lanes(d), splat(d, 1), 0)
    sign = where_greater(d, 0, splat(d, 1), where_greater(0, d, splat(d, -1), 0))
    store(grad, at, (load(grad, at) + sign * slope) * inside)
    return absolute(d) * inside


@_jit
def _loss(counters, image, target, target_blurred, width, height, share, rooms, grad, sums):
    padded = (width + LANES - 1) // LANES * LANES
    area = padded * ((height + LANES - 1) // LANES * LANES)
    across = width - WINDOW + 1
    down = height - WINDOW + 1
    similar = share > 0 and across > 0 and down > 0
    slope = (np.float32(1) - share) / np.float32(3 * width * height)
    scale = -share / np.float32(3 * max(across, 1) * max(down, 1))
    room = padded + 64
    memory = rooms[take(counters, 1)]
    line = memory[: 3 * room]
    moves = memory[3 * room :]
    layer = (_STRIP_ROWS + WINDOW - 1) * room
    strips = (height + _STRIP_ROWS - 1) // _STRIP_ROWS
    while True:
        unit = take(counters, 0)
        if unit >= 3 * strips:
            break
        first = unit % strips * _STRIP_ROWS
        last = min(height, first + _STRIP_ROWS)
        alike = 0.0
        apart = 0.0
        if similar:
            # SSIM of the windows, and what it moves. Windows that begin above the strip reach into it.
            for y in range(first - WINDOW + 1, last):
                at = unit // strips * area + y * padded
                d = (y - first + WINDOW - 1) * room
                if y < 0 or y >= down:
                    for x in range(0, room, LANES):
                        for layers in range(3):
                            store(moves, layers * layer + d + x, 0)
                    continue
                for x in range(0, width, LANES):
                    _down_both(image, target, at + x, padded, line, x, room)
                for x in range(0, across, LANES):
                    similarity = _similarity(
                        line,
                        x,
                        room,
                        target_blurred,
                        at + x,
                        3 * area + 64,
                        across,
                        scale,
                        moves,
                        d + x + WINDOW - 1,
                        layer,
                    )
                    if y >= first:
                        alike += total(similarity)
        # The gradient gathers what all windows around a pixel move; then the difference is added.
        for y in range(first, last):
            at = unit // strips * area + y * padded
            if similar:
                for layers in range(3):
                    for x in range(0, width + WINDOW - 1, LANES):
                        _up(moves, layers * layer + (y - first) * room + x, room, line, layers * room + x)
                for x in range(0, width, LANES):
                    _gradient(image, target, at + x, line, x, room, grad)
            for x in range(0, width, LANES):
                apart += total(_difference(image, target, at + x, width, x, slope, grad))
        sums[unit, 0] = apart
        sums[unit, 1] = alike


def loss(
    image: Floats, target: Floats, target_blurred: Floats, width: int, height: int, share: float
) -> tuple[float, float, Floats]:
    """Mean |image - target|, mean SSIM, and the gradient [planes] of (1 - share) L1 + share (1 - SSIM) in the
    image.

    Where the image is smaller than a window, SSIM counts as 0 and only L1 has a gradient.
    """
    padded = (width + LANES - 1) // LANES * LANES
    grad = np.zeros(3 * padded * ((height + LANES - 1) // LANES * LANES) + 64, np.float32)
    rooms = np.zeros((numba.get_num_threads(), 3 * (padded + 64) * (_STRIP_ROWS + WINDOW)), np.float32)
    sums = np.zeros((3 * -(-height // _STRIP_ROWS), 2))
    on_threads(
        _loss, image, target, target_blurred.reshape(-1), width, height, np.float32(share), rooms, grad, sums
    )
    windows = max(width - WINDOW + 1, 0) * max(height - WINDOW + 1, 0)
    apart, alike = sums.sum(0)
    return float(apart) / (3 * width * height), float(alike) / (3 * max(windows, 1)), grad
