"""Features at pixels from half-precision coefficients: `guided.apply`, compiled by numba on first use and cached.

Layout: one row a stored cell, four runs of P channels (A for red, green and blue, then b), as the bits of float16. P is C
rounded up to whole vectors of LANES: the inner step is explicit vector instructions, since the compiler leaves it scalar.
4096 pixels x 48 channels take 0.6 ms of one core where the coefficients are in its cache, 2.5 ms over 43 views that are not.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg"

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES = 8
"""One AVX register of float32; narrower machines split it."""

PIXELS = 64
"""Pixels of a task."""

Floats: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.float32]]


class ViewArrays(NamedTuple):
    """One view as the kernel takes it: F = scale (A I + b) + centre."""

    bits: np.ndarray[tuple[int, ...], np.dtype[np.uint16]]
    """[rows * columns, 4 P], contiguous."""
    rows: int
    columns: int
    height: int
    width: int
    scale: Floats
    centre: Floats


class ViewTable:
    """Views side by side: where each one's coefficients lie, and what else is known of it."""

    def __init__(self, views: Sequence[ViewArrays]) -> None:
        self._kept = [view.bits for view in views]  # the addresses below must stay good
        self.address = np.array([bits.ctypes.data for bits in self._kept], dtype=np.int64)
        self.shape = np.array([(v.rows, v.columns, v.height, v.width) for v in views], dtype=np.int64)
        self.scale = np.stack([view.scale for view in views]).astype(np.float32)
        self.centre = np.stack([view.centre for view in views]).astype(np.float32)
        self.run = self._kept[0].shape[1] // 4


_WIDE = ir.VectorType(ir.IntType(32), LANES)
_HALVES = ir.VectorType(ir.IntType(16), LANES)
_FLOATS = ir.VectorType(ir.FloatType(), LANES)


@intrinsic
def _add_halves(typingctx, total, at, address, weight):
    """total[at : at + LANES] += weight * 2^-112 * the LANES float16 whose bits lie at an address.

    A half's exponent and mantissa, moved to a float's place, are 2^112 too small; subnormals come out right as well.
    """

    def generate(context, build, signature, arguments):
        def vector(number, offset, kind):
            data = context.make_array(signature.args[number])(context, build, arguments[number]).data
            return build.bitcast(build.gep(data, [offset]), kind.as_pointer())

        def load(pointer, align):
            value = build.load(pointer)
            value.align = align
            return value

        def mask(value):
            return ir.Constant(_WIDE, [value] * LANES)

        target = vector(0, arguments[1], _FLOATS)
        half = build.zext(load(build.inttoptr(arguments[2], _HALVES.as_pointer()), 2), _WIDE)
        sign = build.shl(build.and_(half, mask(0x8000)), mask(16))
        rest = build.shl(build.and_(half, mask(0x7FFF)), mask(13))
        single = build.bitcast(build.or_(sign, rest), _FLOATS)
        undefined = ir.Constant(_FLOATS, ir.Undefined)
        lane = build.insert_element(undefined, arguments[3], ir.Constant(ir.IntType(32), 0))
        splat = build.shuffle_vector(lane, undefined, mask(0))
        product = build.fmul(single, splat, flags=("contract",))
        build.store(build.fadd(load(target, 4), product, flags=("contract",)), target).align = 4
        return context.get_dummy_value()

    return types.void(total, at, types.int64, weight), generate


@numba.njit(inline="always", cache=True)
def _corner(position, cells):
    """Lower cell, upper cell, share of the upper one; NaN falls on the lower border: no index may leave the table."""
    at = position - np.float32(0.5)
    at = min(at, np.float32(cells - 1)) if at > np.float32(0) else np.float32(0)
    low = int(at)
    return low, min(low + 1, cells - 1), at - np.float32(low)


def gather_views(table: ViewTable, slot: np.ndarray, pixel: Floats, rgb: Floats, out: Floats) -> None:
    """out[i] = F at pixel[i] [R 2] with colour rgb[i] [R 3] of the table's view slot[i]."""
    _gather(slot, table.address, table.shape, table.scale, table.centre, table.run, pixel, rgb, out)


@numba.njit(parallel=True, cache=True, nogil=True, fastmath={"contract"})
def _gather(slot, address, shape, scale, centre, run, pixel, rgb, out):
    channels = scale.shape[1]
    exponent = np.float32(2.0**112)
    for task in numba.prange((len(slot) + PIXELS - 1) // PIXELS):
        total = np.empty(run, dtype=np.float32)
        for i in range(task * PIXELS, min(len(slot), task * PIXELS + PIXELS)):
            view = slot[i]
            rows, columns = shape[view, 0], shape[view, 1]
            vertical, horizontal = np.float32(rows / shape[view, 2]), np.float32(columns / shape[view, 3])
            top, bottom, v = _corner(pixel[i, 1] * vertical, rows)
            left, right, u = _corner(pixel[i, 0] * horizontal, columns)
            total[:] = np.float32(0)
            for corner in range(4):
                y, x = (bottom if corner & 2 else top), (right if corner & 1 else left)
                share = (v if corner & 2 else np.float32(1) - v) * (u if corner & 1 else np.float32(1) - u) * exponent
                row = address[view] + (y * columns + x) * 4 * run * 2
                for k in range(4):
                    weight = share * rgb[i, k] if k < 3 else share
                    for s in range(0, run, LANES):
                        _add_halves(total, s, row + (k * run + s) * 2, weight)
            for c in range(channels):
                out[i, c] = total[c] * scale[view, c] + centre[view, c]
