"""Blocks of Gaussians in the compiled rasteriser: how their parameters lie, and the colours that they give.

Parameters of LANES Gaussians lie together, one row of LANES numbers each: mean 0-2, ln scale 3-5, quaternion
wxyz 6-9, logit of the opacity 10, then harmonics [K 3], K = 1, 4, 9 or 16 `bands`. A flat array of blocks, so
that every load is one vector.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg, var-annotated"

from typing import Any

import numpy as np

from ..simd import LANES, load, maximum, splat, square_root
from ..threads import cached_jit, on_threads, take
from . import MAX_COORDINATE, MAX_LOG

Floats = np.ndarray[Any, np.dtype[np.float32]]
FIXED = 11
"""Rows of a block before its harmonics."""
BLOCKS = 64
"""Blocks that a thread takes at a time: 1024 Gaussians; by eye."""
_f = np.float32
_COORDINATE_LIMIT = _f(MAX_COORDINATE)
_LOG_LIMIT = _f(MAX_LOG)
MARK = _f(-70)
"""The logit of the invalid: far below any that is cut at -MAX_LOG."""
MIN_SQUARED_NORM = 1e-24
"""Squared length below which a vector is not made longer; above float32's smallest number."""

jit = cached_jit(nogil=True, fastmath={"contract", "arcp", "nsz"})


@jit
def _pack(counters, means, quaternions, log_scales, logits, harmonics, blocks):
    count = harmonics.shape[0]
    bands = harmonics.shape[1]
    rows = FIXED + 3 * bands
    while True:
        begin = take(counters, 0) * BLOCKS * LANES
        if begin >= count:
            break
        for i in range(begin, min(begin + BLOCKS * LANES, (count + LANES - 1) // LANES * LANES)):
            o = i // LANES * rows * LANES + i % LANES
            # Rows behind the last Gaussian, NaN and what is too large are marked.
            fine = i < count
            if fine:
                fine = logits[i] == logits[i]
                for c in range(3):
                    fine = (
                        fine and abs(means[i, c]) < _COORDINATE_LIMIT and log_scales[i, c] == log_scales[i, c]
                    )
                    for k in range(bands):
                        fine = fine and abs(harmonics[i, k, c]) < _COORDINATE_LIMIT
                for c in range(4):
                    fine = fine and abs(quaternions[i, c]) < _COORDINATE_LIMIT
            if not fine:
                for row in range(rows):
                    blocks[o + row * LANES] = _f(0)
                blocks[o + 10 * LANES] = MARK
                continue
            for c in range(3):
                blocks[o + c * LANES] = means[i, c]
                blocks[o + (3 + c) * LANES] = min(max(log_scales[i, c], -_LOG_LIMIT), _LOG_LIMIT)
            for c in range(4):
                blocks[o + (6 + c) * LANES] = quaternions[i, c]
            blocks[o + 10 * LANES] = min(max(logits[i], -_LOG_LIMIT), _LOG_LIMIT)
            for k in range(bands):
                for c in range(3):
                    blocks[o + (FIXED + 3 * k + c) * LANES] = harmonics[i, k, c]


def pack(
    means: Floats, quaternions: Floats, log_scales: Floats, logits: Floats, harmonics: Floats, blocks: Floats
) -> None:
    """Put arrays [N 3], [N 4], [N 3], [N], [N K 3] into blocks. Scales and opacities are limited to what
    float32 can square; a Gaussian with NaN, or with another number beyond 1e15, is marked as invalid by its
    logit.
    """
    on_threads(_pack, means, quaternions, log_scales, logits, harmonics, blocks)


def direction(mean, view):
    """Unit vectors from the camera to the means, and 1 / distance."""
    dx = mean[0] - view[16]
    dy = mean[1] - view[17]
    dz = mean[2] - view[18]
    shrink = 1 / square_root(maximum(dx * dx + dy * dy + dz * dz, MIN_SQUARED_NORM))
    return dx * shrink, dy * shrink, dz * shrink, shrink


def basis(x, y, z, bands):
    """The first `bands` of the 16 real spherical harmonics at unit vectors, as in
    `harmonics.spherical_harmonics`.
    """
    values = [splat(x, 0.28209479177387814)]
    if bands > 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if bands > 4:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if bands > 9:
        values += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * (x * x + y * y)),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return values


def colour(blocks, at, basis):
    """0.5 + harmonics times the basis: three vectors, before they are cut at 0."""
    colours = [splat(basis[0], 0.5)] * 3
    for k, b in enumerate(basis):
        for c in range(3):
            colours[c] = colours[c] + b * load(blocks, at + (FIXED + 3 * k + c) * LANES)
    return colours


def direction_slopes(direction, bands, blocks, at, of_colours):
    """The gradient of the colour in a unit direction, from that of its channels; components along the
    direction are left in.
    """
    x, y, z = direction
    red, green, blue = of_colours
    gx = gy = gz = splat(x, 0)
    c1 = 0.4886025119029199
    for k in range(1, bands):
        o = at + (FIXED + 3 * k) * LANES
        s = red * load(blocks, o) + green * load(blocks, o + LANES) + blue * load(blocks, o + 2 * LANES)
        if k == 1:
            gy = gy - c1 * s
        elif k == 2:
            gz = gz + c1 * s
        elif k == 3:
            gx = gx - c1 * s
        elif k == 4:
            s = s * 1.0925484305920792
            gx = gx + s * y
            gy = gy + s * x
        elif k == 5:
            s = s * -1.0925484305920792
            gy = gy + s * z
            gz = gz + s * y
        elif k == 6:
            s = s * 0.31539156525252005
            gx = gx - 2 * s * x
            gy = gy - 2 * s * y
            gz = gz + 4 * s * z
        elif k == 7:
            s = s * -1.0925484305920792
            gx = gx + s * z
            gz = gz + s * x
        elif k == 8:
            s = s * 0.5462742152960396
            gx = gx + 2 * s * x
            gy = gy - 2 * s * y
        elif k == 9:
            s = s * -0.5900435899266435
            gx = gx + s * 6 * x * y
            gy = gy + s * 3 * (x * x - y * y)
        elif k == 10:
            s = s * 2.890611442640554
            gx = gx + s * y * z
            gy = gy + s * x * z
            gz = gz + s * x * y
        elif k == 11:
            s = s * -0.4570457994644658
            gx = gx - 2 * s * x * y
            gy = gy + s * (4 * z * z - x * x - 3 * y * y)
            gz = gz + 8 * s * y * z
        elif k == 12:
            s = s * 0.3731763325901154
            gx = gx - 6 * s * x * z
            gy = gy - 6 * s * y * z
            gz = gz + s * (6 * z * z - 3 * (x * x + y * y))
        elif k == 13:
            s = s * -0.4570457994644658
            gx = gx + s * (4 * z * z - 3 * x * x - y * y)
            gy = gy - 2 * s * x * y
            gz = gz + 8 * s * x * z
        elif k == 14:
            s = s * 1.445305721320277
            gx = gx + 2 * s * x * z
            gy = gy - 2 * s * y * z
            gz = gz + s * (x * x - y * y)
        else:
            s = s * -0.5900435899266435
            gx = gx + s * 3 * (x * x - y * y)
            gy = gy - s * 6 * x * y
    return gx, gy, gz
