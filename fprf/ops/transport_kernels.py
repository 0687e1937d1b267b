"""Compiled loops of `fprf.light.transport`: light that reaches points through 3D Gaussians, along one direction.

N Gaussians that take light away, M points that receive it. Everything is in the frame of
the light: x and y lie across its rays, h grows towards the light. A ray at a place q across meets a Gaussian
most at the height h + slope (q - mean), where it takes away

    alpha(q) = opacity exp(-(q - mean)^T S^-1 (q - mean) / 2),      S = covariance across the rays.

Gaussians are listed in cells of a grid across the rays, whose lines may lie at any distances, from the highest
on. A list ends where the rest lies below the point.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg"

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .threads import cached_jit, take

MIN_ALPHA = 1 / 255
"""Opacity below which a Gaussian counts as nothing, as in the rasteriser."""
MAX_POWER = 11.1
"""2 ln 255: beyond it even an opaque Gaussian takes away less than MIN_ALPHA."""
MAX_ALPHA = 0.99
"""Light that one Gaussian takes away at most, as in the rasteriser."""
MIN_LEFT = 1e-3
"""Share of light below which a point is dark, and the list is read no further."""
COLUMNS = 12
"""Numbers of a Gaussian in the frame: mean x y, S^-1 xx xy yy, opacity, h, slope x y, top, extent x y."""
_BLOCK = 1024
"""Gaussians or points that a thread takes at a time."""


class Receivers(NamedTuple):
    """Points that receive light, in its frame."""

    order: NDArray[np.int64]
    """Numbers of the points, cell by cell."""
    points: NDArray[np.float32]
    """x y h [M 3]."""
    cells: NDArray[np.int64]
    """Cell of each [M]."""
    offset: NDArray[np.float32]
    """Height above the point up to which Gaussians count nothing [M]."""
    soft: NDArray[np.float32]
    """Further height from which on they count in full [M]."""


class Lists(NamedTuple):
    """Gaussians in each cell, from the highest on."""

    starts: NDArray[np.int64]
    """Beginnings of the lists of cells, and the end of the last [cells + 1]."""
    ids: NDArray[np.int32]
    rows: NDArray[np.float32]
    """The Gaussians [N COLUMNS]."""


@cached_jit(nogil=True)
def project(counters, gaussians, frame, blur, out):
    """Gaussians in the frame [3 3], whose last row leads to the light; `blur` is a variance that is added across."""
    means, covariances, opacities = gaussians
    count = len(means)
    while True:
        start = take(counters, 0) * _BLOCK
        if start >= count:
            break
        for i in range(start, min(count, start + _BLOCK)):
            c = covariances[i]
            p = means[i]
            # Rows of F C, then F C F^T.
            a0 = frame[0, 0] * c[0] + frame[0, 1] * c[1] + frame[0, 2] * c[2]
            a1 = frame[0, 0] * c[1] + frame[0, 1] * c[3] + frame[0, 2] * c[4]
            a2 = frame[0, 0] * c[2] + frame[0, 1] * c[4] + frame[0, 2] * c[5]
            b0 = frame[1, 0] * c[0] + frame[1, 1] * c[1] + frame[1, 2] * c[2]
            b1 = frame[1, 0] * c[1] + frame[1, 1] * c[3] + frame[1, 2] * c[4]
            b2 = frame[1, 0] * c[2] + frame[1, 1] * c[4] + frame[1, 2] * c[5]
            d0 = frame[2, 0] * c[0] + frame[2, 1] * c[1] + frame[2, 2] * c[2]
            d1 = frame[2, 0] * c[1] + frame[2, 1] * c[3] + frame[2, 2] * c[4]
            d2 = frame[2, 0] * c[2] + frame[2, 1] * c[4] + frame[2, 2] * c[5]
            xx = a0 * frame[0, 0] + a1 * frame[0, 1] + a2 * frame[0, 2]
            xy = a0 * frame[1, 0] + a1 * frame[1, 1] + a2 * frame[1, 2]
            yy = b0 * frame[1, 0] + b1 * frame[1, 1] + b2 * frame[1, 2]
            xh = a0 * frame[2, 0] + a1 * frame[2, 1] + a2 * frame[2, 2]
            yh = b0 * frame[2, 0] + b1 * frame[2, 1] + b2 * frame[2, 2]
            hh = d0 * frame[2, 0] + d1 * frame[2, 1] + d2 * frame[2, 2]
            # What is thinner than the blur is widened and made fainter, so that it takes as much light away.
            sharp = max(xx * yy - xy * xy, np.float32(0))
            # Of long needles the widened products cancel in float32; this sum does not.
            det = max(sharp + blur * (xx + yy) + blur * blur, np.float32(1e-30))
            xx += blur
            yy += blur
            opacity = opacities[i] * math.sqrt(sharp / det)
            h = frame[2, 0] * p[0] + frame[2, 1] * p[1] + frame[2, 2] * p[2]
            row = out[i]
            row[0] = frame[0, 0] * p[0] + frame[0, 1] * p[1] + frame[0, 2] * p[2]
            row[1] = frame[1, 0] * p[0] + frame[1, 1] * p[1] + frame[1, 2] * p[2]
            row[2] = yy / det
            row[3] = -xy / det
            row[4] = xx / det
            row[5] = opacity
            row[6] = h
            row[7] = (yy * xh - xy * yh) / det
            row[8] = (xx * yh - xy * xh) / det
            reach = math.sqrt(max(2 * math.log(max(opacity / MIN_ALPHA, 1e-30)), 0.0))
            row[9] = h + reach * math.sqrt(hh)
            row[10] = reach * math.sqrt(xx) if opacity > MIN_ALPHA else -1.0
            row[11] = reach * math.sqrt(yy) if opacity > MIN_ALPHA else -1.0


@cached_jit(nogil=True)
def count(ranges, columns, starts):
    """Entries of each cell into `starts`, which is then where their lists begin: [cells + 1]."""
    for i in range(len(ranges)):
        for y in range(ranges[i, 2], ranges[i, 3] + 1):
            for x in range(ranges[i, 0], ranges[i, 1] + 1):
                starts[y * columns + x + 1] += 1
    for k in range(len(starts) - 1):
        starts[k + 1] += starts[k]


@cached_jit(nogil=True)
def fill(ranges, columns, places, ids):
    """Lists of Gaussians, in their order; `places` are where the lists begin, and end up where they end."""
    for i in range(len(ranges)):
        for y in range(ranges[i, 2], ranges[i, 3] + 1):
            for x in range(ranges[i, 0], ranges[i, 1] + 1):
                cell = y * columns + x
                ids[places[cell]] = i
                places[cell] += 1


@cached_jit(nogil=True, fastmath={"contract", "arcp"})
def reach(counters, receivers, lists, out):
    """Share of light [M] that reaches points."""
    order = receivers.order
    points = receivers.points
    cells = receivers.cells
    offset = receivers.offset
    soft = receivers.soft
    starts = lists.starts
    ids = lists.ids
    rows = lists.rows
    total = len(order)
    while True:
        start = take(counters, 0) * _BLOCK
        if start >= total:
            break
        for k in range(start, min(total, start + _BLOCK)):
            i = order[k]
            x = points[i, 0]
            y = points[i, 1]
            h = points[i, 2]
            near = offset[i]
            inverse = np.float32(1) / soft[i]
            cell = cells[i]
            left = np.float32(1)
            for e in range(starts[cell], starts[cell + 1]):
                row = rows[ids[e]]
                if row[9] <= h + near:
                    break
                dx = x - row[0]
                dy = y - row[1]
                power = row[2] * dx * dx + row[4] * dy * dy + np.float32(2) * row[3] * dx * dy
                if power > np.float32(MAX_POWER):
                    continue
                above = (row[6] - h + row[7] * dx + row[8] * dy - near) * inverse
                if above <= np.float32(0):
                    continue
                alpha = row[5] * math.exp(np.float32(-0.5) * power)
                if alpha < np.float32(MIN_ALPHA):
                    continue
                left *= np.float32(1) - min(alpha, np.float32(MAX_ALPHA)) * min(above, np.float32(1))
                if left < np.float32(MIN_LEFT):
                    left = np.float32(0)
                    break
            out[i] = left
