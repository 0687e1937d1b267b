"""The inner step of small matrix products: a tile of outputs held in registers while the inputs stream by.

    multiply     out[r, :]  = max(start[r, :] + sum_k x[r, k] w[k, :], floor)     r < rows, : = columns vectors of WIDE numbers
    accumulate   out[r, :] += scale[r] (start[r, :] + sum_k x[r, k] w[k, :])

Each output is one sum over k in order, whatever the tile: results do not depend on how a product is cut.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from .lanes import FUSE, WIDE, address, load, number, splat, store, vector

_LONG = ir.IntType(64)


def _lines(build, base, stride, rows, columns):
    """Pointers to the vectors of each row."""
    firsts = [build.gep(base, [build.mul(stride, number(r))]) for r in range(rows)]
    return [[build.gep(first, [number(c * WIDE)]) for c in range(columns)] for first in firsts]


def _sums(build, x, x_row, x_step, w, w_step, start, s_row, depth, rows, columns):
    """start + x w as [rows][columns] vectors; the block goes on after the loop over k."""
    inputs = [build.gep(x, [build.mul(x_row, number(r))]) for r in range(rows)]
    initial = [[load(build, p, WIDE) for p in line] for line in _lines(build, start, s_row, rows, columns)]
    before, loop, after = build.block, build.append_basic_block("sum"), build.append_basic_block("done")
    build.cbranch(build.icmp_signed(">", depth, number(0)), loop, after)

    build.position_at_end(loop)
    k = build.phi(_LONG)
    held = [[build.phi(vector(WIDE)) for _ in range(columns)] for _ in range(rows)]
    line = build.gep(w, [build.mul(k, w_step)])
    weights = [load(build, build.gep(line, [number(c * WIDE)]), WIDE) for c in range(columns)]
    at = build.mul(k, x_step)
    added = []
    for r in range(rows):
        value = splat(build, build.load(build.gep(inputs[r], [at])), WIDE)
        products = [build.fmul(value, weight, flags=FUSE) for weight in weights]
        added.append([build.fadd(sum_, product, flags=FUSE) for sum_, product in zip(held[r], products, strict=True)])
    following = build.add(k, number(1))
    k.add_incoming(number(0), before)
    k.add_incoming(following, loop)
    build.cbranch(build.icmp_signed("<", following, depth), loop, after)

    build.position_at_end(after)
    results = [[build.phi(vector(WIDE)) for _ in range(columns)] for _ in range(rows)]
    for r in range(rows):
        for c in range(columns):
            held[r][c].add_incoming(initial[r][c], before)
            held[r][c].add_incoming(added[r][c], loop)
            results[r][c].add_incoming(initial[r][c], before)
            results[r][c].add_incoming(added[r][c], loop)
    return results


# Strides of both forms: x by row and by k, w by k, the others by row; `_at` is the first number of each.


def _multiply(rows, columns):
    @intrinsic
    def multiply(typing, x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, out, o_at, o_row, depth, floor):
        signature = types.void(x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, out, o_at, o_row, depth, floor)

        def generate(context, build, signature, args):
            x, w, start, out = (address(context, build, signature.args[i], args[i], args[i + 1]) for i in (0, 4, 7, 10))
            (x_row, x_step), w_step, s_row, (o_row, depth, floor) = args[2:4], args[6], args[9], args[12:]
            results = _sums(build, x, x_row, x_step, w, w_step, start, s_row, depth, rows, columns)
            least = splat(build, floor, WIDE)
            for values, pointers in zip(results, _lines(build, out, o_row, rows, columns), strict=True):
                for value, pointer in zip(values, pointers, strict=True):
                    # Ordered: a NaN is not below the floor and stays.
                    store(build, build.select(build.fcmp_ordered("<", value, least), least, value), pointer)
            return context.get_dummy_value()

        return signature, generate

    return multiply


def _accumulate(rows, columns):
    @intrinsic
    def accumulate(
        typing, x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, out, o_at, o_row, depth, scale, c_at, c_row
    ):
        signature = types.void(
            x, x_at, x_row, x_step, w, w_at, w_step, start, s_at, s_row, out, o_at, o_row, depth, scale, c_at, c_row
        )

        def generate(context, build, signature, args):
            x, w, start, out, scale = (
                address(context, build, signature.args[i], args[i], args[i + 1]) for i in (0, 4, 7, 10, 14)
            )
            (x_row, x_step), w_step, s_row, (o_row, depth), c_row = args[2:4], args[6], args[9], args[12:14], args[16]
            results = _sums(build, x, x_row, x_step, w, w_step, start, s_row, depth, rows, columns)
            for r, (values, pointers) in enumerate(zip(results, _lines(build, out, o_row, rows, columns), strict=True)):
                factor = splat(build, build.load(build.gep(scale, [build.mul(c_row, number(r))])), WIDE)
                for value, pointer in zip(values, pointers, strict=True):
                    scaled = build.fmul(value, factor, flags=FUSE)
                    store(build, build.fadd(load(build, pointer, WIDE), scaled, flags=FUSE), pointer)
            return context.get_dummy_value()

        return signature, generate

    return accumulate


# As many sums as registers hold beside the weights: 24 of 32 on machines with 512 bits, 12 of 16 elsewhere.
ROWS_4, ROWS_3, ROWS_2, ROWS_1 = (6, 8, 12, 16) if WIDE == 16 else (3, 4, 6, 12)
"""Rows of the tile with so many columns of vectors."""
multiply_4, multiply_3, multiply_2, multiply_1 = (
    _multiply(rows, columns) for rows, columns in ((ROWS_4, 4), (ROWS_3, 3), (ROWS_2, 2), (ROWS_1, 1))
)
accumulate_4, accumulate_3, accumulate_2, accumulate_1 = (
    _accumulate(rows, columns) for rows, columns in ((ROWS_4, 4), (ROWS_3, 3), (ROWS_2, 2), (ROWS_1, 1))
)
