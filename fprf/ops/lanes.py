"""Vectors of float32 for compiled kernels, as building blocks of LLVM code.

Left to itself the compiler keeps most of our inner loops scalar (it cannot prove that their arrays do not overlap), so they
are written as explicit vector instructions. Only multiply-add fusion is allowed: no re-association, so a result does not
depend on the width of the machine's vectors, but for that fusion.

exp and 1 - exp(-x):  x = n ln 2 + r,  |r| <= ln 2 / 2,  e^x - 1 = 2^n p + (2^n - 1)  with  p = e^r - 1 by its series to r^7.
The series' remainder is below 5e-9 |p|, so p errs by about one unit round-off and so do the functions (at most 3u, u = 2^-24).
NaN stays NaN; exp is 0 below -87.33 and infinite above 88.3, where 2^n would leave float32's normal range.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import math

from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic

__all__ = [
    "BLOCK",
    "FUSE",
    "WIDE",
    "add_lanes",
    "address",
    "copy_lanes",
    "exp_lanes",
    "load",
    "number",
    "opaque_lanes",
    "splat",
    "store",
    "vector",
]


def _wide() -> int:
    try:
        return 16 if binding.get_host_cpu_features().get("avx512f") else 8
    except RuntimeError:  # the features of some machines cannot be read
        return 8


WIDE = _wide()
"""Float32 numbers in the machine's widest register, at least 8; narrower machines split it."""

BLOCK = 48
"""Points or rows that kernels take at a time: whole tiles of every shape, small enough for the first-level cache."""

FUSE = ("contract",)
"""Multiply and add may round once."""

_FLOAT, _INDEX, _LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)


def vector(lanes, element=_FLOAT):
    """The type of `lanes` numbers."""
    return ir.VectorType(element, lanes)


def number(value):
    """A 64-bit integer constant."""
    return ir.Constant(_LONG, value)


def constant(value, lanes):
    """A float32 constant in every lane."""
    return ir.Constant(vector(lanes), [value] * lanes)


def splat(build, value, lanes):
    """A number in every lane."""
    empty = ir.Constant(vector(lanes, value.type), ir.Undefined)
    one = build.insert_element(empty, value, ir.Constant(_INDEX, 0))
    return build.shuffle_vector(one, empty, ir.Constant(vector(lanes, _INDEX), [0] * lanes))


def address(context, build, kind, array, offset):
    """Pointer to a number of a contiguous array."""
    return build.gep(context.make_array(kind)(context, build, array).data, [offset])


def load(build, pointer, lanes):
    """Numbers from anywhere: no alignment is asked for."""
    value = build.load(build.bitcast(pointer, vector(lanes).as_pointer()))
    value.align = 4
    return value


def store(build, value, pointer):
    """A vector to anywhere."""
    build.store(value, build.bitcast(pointer, value.type.as_pointer())).align = 4


@intrinsic
def copy_lanes(typing, x, at, out, to):
    """out[to : to + WIDE] = x[at : at + WIDE]."""
    signature = types.void(x, at, out, to)

    def generate(context, build, signature, args):
        x, at, out, to = args
        value = load(build, address(context, build, signature.args[0], x, at), WIDE)
        store(build, value, address(context, build, signature.args[2], out, to))
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def add_lanes(typing, x, at, y, y_at, out, to):
    """out = x + y."""
    signature = types.void(x, at, y, y_at, out, to)

    def generate(context, build, signature, args):
        x, at, y, y_at, out, to = args
        first = load(build, address(context, build, signature.args[0], x, at), WIDE)
        second = load(build, address(context, build, signature.args[2], y, y_at), WIDE)
        store(build, build.fadd(first, second), address(context, build, signature.args[4], out, to))
        return context.get_dummy_value()

    return signature, generate


_LOWEST, _HIGHEST = -87.33, 88.3
"""Between them 2^n is a normal float32."""
_ROUND = 1.5 * 2**23
"""Added to a small number, its last bit is worth 1: the sum's bits end in the rounded number."""
# ln 2 in two parts: n times the first is exact for |n| <= 128.
_LN2_HIGH = 355 / 512
_LN2_LOW = math.log(2) - _LN2_HIGH


def _same(value):
    return constant(value, WIDE)


def _parts(build, x):
    """e^r - 1 and 2^n of x; x between the limits."""
    rounded = build.fadd(build.fmul(x, _same(1 / math.log(2))), _same(_ROUND))
    n = build.fsub(rounded, _same(_ROUND))
    r = build.fsub(x, build.fmul(n, _same(_LN2_HIGH)), flags=FUSE)
    r = build.fsub(r, build.fmul(n, _same(_LN2_LOW), flags=FUSE), flags=FUSE)
    series = _same(1 / math.factorial(7))
    for k in (6, 5, 4, 3, 2):
        series = build.fadd(build.fmul(series, r, flags=FUSE), _same(1 / math.factorial(k)), flags=FUSE)
    p = build.fadd(build.fmul(build.fmul(r, r), series, flags=FUSE), r, flags=FUSE)
    whole = vector(WIDE, _INDEX)
    # The low bits of `rounded` are n; moved into the exponent beside a bias of 127 they are 2^n.
    exponent = build.add(build.bitcast(rounded, whole), ir.Constant(whole, [127] * WIDE))
    return p, build.bitcast(build.shl(exponent, ir.Constant(whole, [23] * WIDE)), vector(WIDE))


def _limit(build, x, low, high):
    x = build.select(build.fcmp_ordered("<", x, _same(low)), _same(low), x)
    return build.select(build.fcmp_ordered(">", x, _same(high)), _same(high), x)


def _exp(build, x):
    p, power = _parts(build, _limit(build, x, _LOWEST, _HIGHEST))
    value = build.fadd(build.fmul(power, p, flags=FUSE), power, flags=FUSE)
    value = build.select(build.fcmp_ordered("<", x, _same(_LOWEST)), _same(0.0), value)
    return build.select(build.fcmp_ordered(">", x, _same(_HIGHEST)), _same(math.inf), value)


def _opaque(build, x):
    """1 - exp(-x) for x >= 0; below 2^-25 of 1 nothing is left of exp(-x)."""
    p, power = _parts(build, _limit(build, build.fsub(_same(-0.0), x), -18.0, 0.0))
    value = build.fadd(build.fmul(power, p, flags=FUSE), build.fsub(power, _same(1.0)), flags=FUSE)
    return build.fsub(_same(-0.0), value)


def _lanes(function, text):
    @intrinsic
    def lanes(typing, source, at, out, to):
        signature = types.void(source, at, out, to)

        def generate(context, build, signature, args):
            source, at, out, to = args
            x = load(build, address(context, build, signature.args[0], source, at), WIDE)
            store(build, function(build, x), address(context, build, signature.args[2], out, to))
            return context.get_dummy_value()

        return signature, generate

    lanes.__doc__ = f"out[to : to + WIDE] = {text} of x = source[at : at + WIDE]."
    return lanes


exp_lanes = _lanes(_exp, "exp(x)")
opaque_lanes = _lanes(_opaque, "1 - exp(-x), x >= 0")
