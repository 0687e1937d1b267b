"""Vectors of sixteen float32 as a type of compiled kernels: `+ - * /`, tuples of vectors, and the functions below.

The instructions are plain LLVM code for any processor; narrower ones split a vector. Multiply and add may fuse and a division
may become a product with the reciprocal, nothing else: NaN and infinity keep their meaning. Only `sums` and `total` add lanes,
in pairs. A number among vectors counts in every lane.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg"

import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

__all__ = [
    "LANES",
    "absolute",
    "add_scaled",
    "dot",
    "exp2",
    "exp2_rough",
    "lanes",
    "largest",
    "load",
    "loads",
    "log2",
    "maximum",
    "minimum",
    "splat",
    "splats",
    "square_root",
    "store",
    "stores",
    "sums",
    "total",
    "where_greater",
    "zeros",
]

LANES = 16
"""Numbers of a vector."""

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_VECTOR, _INTS = ir.VectorType(_FLOAT, LANES), ir.VectorType(_INT, LANES)
_FUSE = ("contract", "arcp", "nsz")
_ADD_ANYHOW = ("contract", "arcp", "nsz", "reassoc")


class _VectorType(types.Type):
    def __init__(self):
        super().__init__(name=f"float32x{LANES}")


_vector = _VectorType()


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _VECTOR)


def _same(value):
    return ir.Constant(_VECTOR, [float(np.float32(value))] * LANES)


def _same_int(value):
    return ir.Constant(_INTS, [int(value)] * LANES)


def _undefined():
    return ir.Constant(_VECTOR, ir.Undefined)


def _broadcast(build, value):
    vector = build.insert_element(_undefined(), value, ir.Constant(_INT, 0))
    return build.shuffle_vector(vector, _undefined(), ir.Constant(_INTS, [0] * LANES))


def _to_vector(context, build, kind, value):
    return value if kind == _vector else _broadcast(build, context.cast(build, value, kind, types.float32))


def _define_binary(function, instruction):
    @infer_global(function)
    class Template(AbstractTemplate):
        def generic(self, args, kws):
            if len(args) == 2 and _vector in args and all(isinstance(a, _VectorType | types.Number) for a in args):
                return signature(_vector, *args)
            return None

    def lower(context, build, sig, args):
        x, y = (_to_vector(context, build, kind, value) for kind, value in zip(sig.args, args, strict=True))
        return getattr(build, instruction)(x, y, flags=_FUSE)

    for kinds in ((_vector, _vector), (_vector, types.Number), (types.Number, _vector)):
        lower_builtin(function, *kinds)(lower)


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
    (operator.iadd, "fadd"),
    (operator.isub, "fsub"),
    (operator.imul, "fmul"),
):
    _define_binary(_function, _instruction)


@infer_global(operator.neg)
class _Negative(AbstractTemplate):
    def generic(self, args, kws):
        return signature(_vector, _vector) if args[0] == _vector else None


@lower_builtin(operator.neg, _vector)
def _lower_negative(context, build, sig, args):
    return build.fsub(_same(-0.0), args[0], flags=_FUSE)


def _call(build, name, args, result=_VECTOR, flags=_FUSE):
    function = cgutils.get_or_insert_function(build.module, ir.FunctionType(result, [a.type for a in args]), name)
    return build.call(function, args, fastmath=flags)


def _element(context, build, kind, array, index, index_kind):
    data = context.make_array(kind)(context, build, array).data
    return build.gep(data, [context.cast(build, index, index_kind, types.intp)])


def _load(context, build, kind, array, index, index_kind):
    place = build.bitcast(_element(context, build, kind, array, index, index_kind), _VECTOR.as_pointer())
    return build.load(place, align=4)


def _store(context, build, kind, array, index, index_kind, value):
    place = build.bitcast(_element(context, build, kind, array, index, index_kind), _VECTOR.as_pointer())
    build.store(value, place, align=4)


@intrinsic
def load(typing, array, at):
    """array[at : at + LANES] of a contiguous array."""
    return _vector(array, at), lambda context, build, sig, args: _load(
        context, build, sig.args[0], args[0], args[1], sig.args[1]
    )


@intrinsic
def store(typing, array, at, value):
    """array[at : at + LANES] = value."""

    def generate(context, build, sig, args):
        vector = _to_vector(context, build, sig.args[2], args[2])
        _store(context, build, sig.args[0], args[0], args[1], sig.args[1], vector)
        return context.get_dummy_value()

    return types.void(array, at, value), generate


def _count(kind):
    return kind.literal_value if isinstance(kind, types.IntegerLiteral) else None


@intrinsic(prefer_literal=True)
def loads(typing, array, at, step, count):
    """`count` vectors, from array[at], array[at + step] and so on; count is a constant."""
    if _count(count) is None:
        return None

    def generate(context, build, sig, args):
        index = context.cast(build, args[1], sig.args[1], types.intp)
        step = context.cast(build, args[2], sig.args[2], types.intp)
        found = []
        for _ in range(_count(sig.args[3])):
            found.append(_load(context, build, sig.args[0], args[0], index, types.intp))
            index = build.add(index, step)
        return context.make_tuple(build, sig.return_type, found)

    return types.UniTuple(_vector, _count(count))(array, at, step, count), generate


@intrinsic
def stores(typing, array, at, step, values):
    """Vectors to array[at], array[at + step] and so on."""

    def generate(context, build, sig, args):
        index = context.cast(build, args[1], sig.args[1], types.intp)
        step = context.cast(build, args[2], sig.args[2], types.intp)
        for k in range(len(sig.args[3])):
            _store(context, build, sig.args[0], args[0], index, types.intp, build.extract_value(args[3], k))
            index = build.add(index, step)
        return context.get_dummy_value()

    return types.void(array, at, step, values), generate


@intrinsic(prefer_literal=True)
def splats(typing, array, at, count):
    """array[at], array[at + 1] and so on, each in every lane of a vector of its own; count is a constant."""
    if _count(count) is None:
        return None

    def generate(context, build, sig, args):
        first = _element(context, build, sig.args[0], args[0], args[1], sig.args[1])
        places = [build.gep(first, [ir.Constant(_INT, k)]) for k in range(_count(sig.args[2]))]
        return context.make_tuple(build, sig.return_type, [_broadcast(build, build.load(place)) for place in places])

    return types.UniTuple(_vector, _count(count))(array, at, count), generate


@intrinsic(prefer_literal=True)
def zeros(typing, count):
    """So many vectors of 0; count is a constant."""
    if _count(count) is None:
        return None
    return types.UniTuple(_vector, _count(count))(count), lambda context, build, sig, args: context.make_tuple(
        build, sig.return_type, [_same(0)] * _count(sig.args[0])
    )


@intrinsic
def add_scaled(typing, values, factor, more):
    """values + factor * more, tuples of vectors and one vector."""

    def generate(context, build, sig, args):
        values, factor, more = args
        found = []
        for k in range(len(sig.args[0])):
            product = build.fmul(factor, build.extract_value(more, k), flags=_FUSE)
            found.append(build.fadd(build.extract_value(values, k), product, flags=_FUSE))
        return context.make_tuple(build, sig.return_type, found)

    return values(values, factor, more), generate


@intrinsic
def dot(typing, first, second):
    """The sum of the products of two tuples of vectors, a vector."""

    def generate(context, build, sig, args):
        found = _same(0)
        for k in range(len(sig.args[0])):
            product = build.fmul(build.extract_value(args[0], k), build.extract_value(args[1], k), flags=_FUSE)
            found = build.fadd(found, product, flags=_FUSE)
        return found

    return _vector(first, second), generate


@intrinsic
def splat(typing, value):
    """A number in every lane."""
    return _vector(value), lambda context, build, sig, args: _to_vector(context, build, sig.args[0], args[0])


@intrinsic
def lanes(typing):
    """0, 1, 2 ..."""
    return _vector(), lambda context, build, sig, args: ir.Constant(_VECTOR, [float(k) for k in range(LANES)])


def _choose(comparison):
    @intrinsic
    def function(typing, x, y):
        def generate(context, build, sig, args):
            a, b = (_to_vector(context, build, kind, value) for kind, value in zip(sig.args, args, strict=True))
            return build.select(build.fcmp_ordered(comparison, a, b), a, b)

        return _vector(x, y), generate

    return function


minimum, maximum = _choose("<"), _choose(">")


@intrinsic
def where_greater(typing, p, q, x, y):
    """x where p > q, else y: also where p or q is NaN."""

    def generate(context, build, sig, args):
        p, q, x, y = (_to_vector(context, build, kind, value) for kind, value in zip(sig.args, args, strict=True))
        return build.select(build.fcmp_ordered(">", p, q), x, y)

    return _vector(p, q, x, y), generate


@intrinsic
def square_root(typing, x):
    """Square root."""
    return _vector(x), lambda context, build, sig, args: _call(build, f"llvm.sqrt.v{LANES}f32", [args[0]])


@intrinsic
def absolute(typing, x):
    """|x|."""
    return _vector(x), lambda context, build, sig, args: _call(build, f"llvm.fabs.v{LANES}f32", [args[0]])


@intrinsic
def total(typing, x):
    """The sum of the lanes."""
    return types.float32(x), lambda context, build, sig, args: _call(
        build, f"llvm.vector.reduce.fadd.v{LANES}f32", [ir.Constant(_FLOAT, 0.0), args[0]], _FLOAT, _ADD_ANYHOW
    )


@intrinsic
def largest(typing, x):
    """The largest of the lanes."""
    return types.float32(x), lambda context, build, sig, args: _call(
        build, f"llvm.vector.reduce.fmax.v{LANES}f32", [args[0]], _FLOAT
    )


@intrinsic
def sums(typing, values):
    """The sums of the lanes of each of at most LANES vectors, in the lanes of one; what is left over is undefined."""

    def generate(context, build, sig, args):
        found = [build.extract_value(args[0], k) for k in range(len(sig.args[0]))]
        fours = LANES // 4

        def halve(low, high):
            """Add picked lanes of each pair of vectors: half as many vectors."""
            halved = []
            for k in range(0, len(found), 2):
                x, y = found[k], found[k + 1] if k + 1 < len(found) else _undefined()
                picked = [build.shuffle_vector(x, y, ir.Constant(_INTS, mask)) for mask in (low, high)]
                halved.append(build.fadd(*picked, flags=_FUSE))
            return halved

        def within_fours(*offsets):
            return [4 * g + o for g in range(fours) for o in offsets]

        found = halve(within_fours(0, LANES, 1, LANES + 1), within_fours(2, LANES + 2, 3, LANES + 3))
        found = halve(within_fours(0, 1, LANES, LANES + 1), within_fours(2, 3, LANES + 2, LANES + 3))
        left = fours
        while left > 1:
            # Group g of a vector holds the partial sums of four of them; the groups of one vector are added in pairs.
            low, high = (
                [side * LANES + 4 * g + j for side in (0, 1) for g in range(first, fours, 2) for j in range(4)]
                for first in (0, 1)
            )
            found, left = halve(low, high), left // 2
        assert len(found) == 1
        return found[0]

    return _vector(values), generate


def _fit(function, degree, low, high):
    """Coefficients of the polynomial of least relative error, in the mean, at Chebyshev points."""
    x = np.cos(np.pi * (np.arange(400) + 0.5) / 400) * (high - low) / 2 + (high + low) / 2
    powers = x[:, None] ** np.arange(degree + 1) / function(x)[:, None]
    return np.linalg.lstsq(powers, np.ones_like(x), rcond=None)[0]


def _polynomial(build, coefficients, x):
    value = _same(coefficients[-1])
    for each in coefficients[-2::-1]:
        value = build.fadd(build.fmul(value, x, flags=_FUSE), _same(each), flags=_FUSE)
    return value


_ROUND = 1.5 * 2**23
"""Added to a small number, the sum's last bits are the rounded number."""


def _exp2(degree, text):
    coefficients = _fit(np.exp2, degree, -0.5, 0.5)

    @intrinsic
    def function(typing, x):
        def generate(context, build, sig, args):
            rounded = build.fadd(args[0], _same(_ROUND))
            part = build.fsub(args[0], build.fsub(rounded, _same(_ROUND)))
            value = _polynomial(build, coefficients, part)
            exponent = build.shl(build.bitcast(rounded, _INTS), _same_int(23))
            return build.bitcast(build.add(exponent, build.bitcast(value, _INTS)), _VECTOR)

        return _vector(x), generate

    function.__doc__ = f"2^x for |x| < 126; relative error {text}."
    return function


exp2_rough, exp2 = _exp2(3, "1.1e-4"), _exp2(5, "3e-7")

_LOG2 = (
    np.polynomial.chebyshev.Chebyshev.interpolate(
        lambda m: np.log2(1 + m) / np.where(np.abs(m) < 1e-9, 1, m), 8, [0.5**0.5 - 1, 2**0.5 - 1]
    )
    .convert(kind=np.polynomial.Polynomial)
    .coef
)


@intrinsic
def log2(typing, x):
    """log2 of a positive normal number; error 3e-7 of the larger of 1 and itself."""

    def generate(context, build, sig, args):
        bits = build.bitcast(args[0], _INTS)
        # From 2^-0.5 on: 0x3f3504f3 are the bits of the square root of one half.
        exponent = build.ashr(build.sub(bits, _same_int(0x3F3504F3)), _same_int(23))
        mantissa = build.bitcast(build.sub(bits, build.shl(exponent, _same_int(23))), _VECTOR)
        part = build.fsub(mantissa, _same(1.0))
        found = build.fmul(_polynomial(build, _LOG2, part), part, flags=_FUSE)
        return build.fadd(found, build.sitofp(exponent, _VECTOR), flags=_FUSE)

    return _vector(x), generate
