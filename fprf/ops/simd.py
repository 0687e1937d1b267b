"""Vectors of float32 in compiled kernels: of LANES, where nothing else is asked for.

A function under `@traced` runs while a kernel that calls it is compiled: once, on placeholders whose
operators emit LLVM code. Inside it loops and conditions on Python numbers unroll, and other traced functions
are plain calls. A kernel passes it arrays (or `stack` memory), indices, constants, float32 numbers, vectors
and tuples of vectors, and gets vectors or numbers back; numba infers no types within, which is most of what
compilation costs. Left to itself the compiler keeps most of our inner loops scalar: it cannot prove that
their arrays do not overlap.

The instructions are plain LLVM code for any processor; narrower ones split a vector. Multiply and add may
fuse and a division may become a product with the reciprocal, nothing else: NaN and infinity keep their
meaning. Only `sums` and `total` add lanes, in pairs: no other result depends on the width of vectors, but for
that fusion. A number among vectors counts in every lane.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, import-untyped, call-arg"

from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, builtin_registry, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
"""Numbers of a vector."""
NARROW = 8
"""Numbers of one AVX register: channels of planes come in groups of so many."""
try:
    WIDE = 16 if binding.get_host_cpu_features().get("avx512f") else 8
    """Numbers of the machine's widest register, at least 8."""
except RuntimeError:  # the features of some machines cannot be read
    WIDE = 8

BLOCK = 48
"""Points or rows that kernels take at a time: whole tiles of every shape, small enough for the first-level
cache.
"""

_CACHE_LINE_BYTES = 64  # of x86 and most ARM processors
_FLOAT = ir.FloatType()
_INT = ir.IntType(32)  # as wide as a float: bits of one
_LONG = ir.IntType(64)  # numba's integers
_FUSE = ("contract", "arcp", "nsz")
_ADD_ANYHOW = ("contract", "arcp", "nsz", "reassoc")


class _VectorType(types.Type):
    def __init__(self, lanes):
        super().__init__(name=f"float32x{lanes}")
        self.lanes = lanes


def _floats(lanes):
    return ir.VectorType(_FLOAT, lanes)


def _ints(lanes):
    return ir.VectorType(_INT, lanes)


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, _floats(kind.lanes))


def _same(value, lanes=LANES):
    return ir.Constant(_floats(lanes), [float(np.float32(value))] * lanes)


def _same_int(value, lanes):
    return ir.Constant(_ints(lanes), [int(value)] * lanes)


def _undefined(lanes):
    return ir.Constant(_floats(lanes), ir.Undefined)


def _long(index):
    return index.value if isinstance(index, _Index) else ir.Constant(_LONG, index)


class _Placeholder:
    """A value of the kernel that is being compiled."""

    __array_ufunc__ = None  # operators with numpy's numbers are ours

    def __init__(self, build, value):
        self.build = build
        self.value = value


def _of_integers(instruction):
    """The operator of an instruction on integers."""
    return lambda self, other: _Index(self.build, getattr(self.build, instruction)(self.value, _long(other)))


def _of_vectors(instruction, *, swapped=False):
    """The operator of an instruction on vectors and constants, of which one is a vector."""

    def operate(self, other):
        x, y = (other, self) if swapped else (self, other)
        return Vector(self.build, getattr(self.build, instruction)(self.same(x), self.same(y), flags=_FUSE))

    return operate


class _Index(_Placeholder):
    """An integer: a place in an array."""

    __add__ = _of_integers("add")
    __sub__ = _of_integers("sub")
    __mul__ = _of_integers("mul")
    __radd__ = __add__
    __rmul__ = __mul__


class _Array(_Placeholder):
    """A contiguous array of float32. Indexed, it gives a number in every lane."""

    def at(self, index):
        return self.build.gep(self.value, [_long(index)])

    def __getitem__(self, index):
        return _broadcast(self.build, self.build.load(self.at(index)))


class _Float(_Placeholder):
    """A float32 that goes back to the kernel."""


class Vector(_Placeholder):
    """Float32 side by side."""

    @property
    def lanes(self):
        return self.value.type.count

    def same(self, other):
        """The LLVM value of a vector, or of a constant in every lane."""
        return other.value if isinstance(other, Vector) else _same(other, self.lanes)

    __add__ = _of_vectors("fadd")
    __radd__ = _of_vectors("fadd", swapped=True)
    __sub__ = _of_vectors("fsub")
    __rsub__ = _of_vectors("fsub", swapped=True)
    __mul__ = _of_vectors("fmul")
    __rmul__ = _of_vectors("fmul", swapped=True)
    __truediv__ = _of_vectors("fdiv")
    __rtruediv__ = _of_vectors("fdiv", swapped=True)

    def __neg__(self):
        return -0.0 - self


def _broadcast(build, value):
    vector = build.insert_element(_undefined(LANES), value, ir.Constant(_INT, 0))
    return Vector(build, build.shuffle_vector(vector, _undefined(LANES), _same_int(0, LANES)))


def _wrapped(context, build, kind, value):
    """The placeholder of an argument; an integer constant is itself."""
    if isinstance(kind, types.IntegerLiteral):
        return kind.literal_value
    if isinstance(kind, types.UniTuple):
        parts = [build.extract_value(value, k) for k in range(kind.count)]
        return tuple(_wrapped(context, build, kind.dtype, part) for part in parts)
    if isinstance(kind, types.Array):
        return _Array(
            build, value if context is None else context.make_array(kind)(context, build, value).data
        )
    if isinstance(kind, types.CPointer):
        return _Array(build, value)
    if isinstance(kind, types.Integer):
        return _Index(build, value if context is None else context.cast(build, value, kind, types.intp))
    if isinstance(kind, types.Float):
        return _broadcast(
            build, value if context is None else context.cast(build, value, kind, types.float32)
        )
    return Vector(build, value)


def _dry(kind):
    """The LLVM type of an argument in a trace that only asks what comes back."""
    if isinstance(kind, types.UniTuple):
        return ir.LiteralStructType([_dry(kind.dtype)] * kind.count)
    if isinstance(kind, types.Array | types.CPointer):
        return _FLOAT.as_pointer()
    if isinstance(kind, types.Integer):
        return _LONG
    return _FLOAT if isinstance(kind, types.Float) else _floats(kind.lanes)


def traced(function):
    """Let kernels call a function that runs while they are compiled. It stays what it is for other traced
    functions.
    """
    results: dict[Any, Any] = {}  # the kind of the result, by those of the arguments

    class Template(AbstractTemplate):
        key = function
        prefer_literal = True

        def generic(self, args, kws):
            if args in results:
                return signature(results[args], *args)
            # What comes back is seen in a trace whose code is thrown away.
            body = ir.Function(
                ir.Module(), ir.FunctionType(ir.VoidType(), [_dry(kind) for kind in args]), "dry"
            )
            build = ir.IRBuilder(body.append_basic_block())
            result = function(
                *(_wrapped(None, build, kind, value) for kind, value in zip(args, body.args, strict=True))
            )
            if result is None:
                results[args] = types.void
            elif isinstance(result, tuple | list):
                results[args] = types.UniTuple(_VectorType(result[0].lanes), len(result))
            elif isinstance(result, Vector):
                results[args] = _VectorType(result.lanes)
            else:
                results[args] = types.int64 if isinstance(result, _Index) else types.float32
            return signature(results[args], *args)

    builtin_registry.register_global(function, types.Function(Template))

    @lower_builtin(function, types.VarArg(types.Any))
    def lower(context, build, sig, args):
        result = function(
            *(_wrapped(context, build, kind, value) for kind, value in zip(sig.args, args, strict=True))
        )
        if result is None:
            return context.get_dummy_value()
        if isinstance(result, tuple | list):
            return context.make_tuple(build, sig.return_type, [each.value for each in result])
        return result.value

    return function


def _call(name, *args, flags=_FUSE):
    """The LLVM value that an intrinsic makes of a vector, or of numbers and one: a vector, or a number by
    reduction.
    """
    *numbers, vector = args
    build = vector.build
    given = [*numbers, vector.value]
    kind = ir.FunctionType(_FLOAT if ".reduce." in name else vector.value.type, [each.type for each in given])
    function = cgutils.get_or_insert_function(build.module, kind, f"{name}.v{vector.lanes}f32")
    return build.call(function, given, fastmath=flags)


def aligned(count: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Room for `count` float32 that begins with a line of the cache."""
    room = np.empty(count + _CACHE_LINE_BYTES // 4, np.float32)
    first = -room.ctypes.data % _CACHE_LINE_BYTES // 4
    return room[first : first + count]


@intrinsic(prefer_literal=True)
def stack(typing, count):
    """Memory for `count` float32, a constant, as long as the kernel runs."""
    if not isinstance(count, types.IntegerLiteral):
        return None

    def generate(context, build, sig, args):
        place = cgutils.alloca_once(build, _FLOAT, ir.Constant(_LONG, sig.args[0].literal_value))
        place.align = _CACHE_LINE_BYTES  # else every vector lies in two lines of the cache
        return place

    return types.CPointer(types.float32)(count), generate


@traced
def load(array, at, lanes=LANES):
    """array[at : at + lanes]."""
    build = array.build
    return Vector(build, build.load(build.bitcast(array.at(at), _floats(lanes).as_pointer()), align=4))


def load_halves(address, lanes):
    """2^-112 of the float16 numbers whose bits lie at an address.

    A half's exponent and mantissa, moved to a float's place, are 2^112 too small; subnormals come out right
    as well.
    """
    build = address.build
    halves = build.inttoptr(address.value, ir.VectorType(ir.IntType(16), lanes).as_pointer())
    half = build.zext(build.load(halves, align=2), _ints(lanes))
    sign = build.shl(build.and_(half, _same_int(0x8000, lanes)), _same_int(16, lanes))
    rest = build.shl(build.and_(half, _same_int(0x7FFF, lanes)), _same_int(13, lanes))
    return Vector(build, build.bitcast(build.or_(sign, rest), _floats(lanes)))


@traced
def store(array, at, value):
    """array[at :] = value, a vector or the constant of LANES lanes."""
    value = value.value if isinstance(value, Vector) else _same(value)
    array.build.store(value, array.build.bitcast(array.at(at), value.type.as_pointer()), align=4)


@traced
def prefetch(array, at):
    """Ask for the line of the cache that holds array[at], which need not exist."""
    build = array.build
    byte = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, _INT, _INT, _INT])
    function = cgutils.get_or_insert_function(build.module, kind, "llvm.prefetch.p0")
    # To read, into the first-level cache, as data.
    build.call(function, [build.bitcast(array.at(at), byte), *(ir.Constant(_INT, k) for k in (0, 3, 1))])


def repeat(count, start, step, by=1):
    """A loop of the compiled code: vectors = step(k, vectors) from `start` on, for k = 0, by, 2 by, ... below
    `count`.
    """
    build = start[0].build
    count = _long(count)
    before = build.block
    loop = build.append_basic_block("loop")
    after = build.append_basic_block("after")
    build.cbranch(build.icmp_signed(">", count, _long(0)), loop, after)
    build.position_at_end(loop)
    k = build.phi(_LONG)
    held = [build.phi(each.value.type) for each in start]
    found = step(_Index(build, k), [Vector(build, each) for each in held])
    following = build.add(k, _long(by))
    end = build.block
    build.cbranch(build.icmp_signed("<", following, count), loop, after)
    build.position_at_end(after)
    results = [build.phi(each.value.type) for each in start]
    firsts = [each.value for each in start]
    lasts = [each.value for each in found]
    for phi, first, last in zip(
        [k, *held, *results], [_long(0), *firsts * 2], [following, *lasts * 2], strict=True
    ):
        phi.add_incoming(first, before)
        phi.add_incoming(last, end)
    return [Vector(build, each) for each in results]


def splat(like, value, lanes=LANES):
    """A constant in every lane."""
    return Vector(like.build, _same(value, lanes))


def lanes(like, values=range(LANES)):
    """0, 1, 2 ..., or a number for each lane."""
    return Vector(like.build, ir.Constant(_floats(LANES), [float(k) for k in values]))


def as_float(index):
    """An index as a number in every lane."""
    return _broadcast(index.build, index.build.sitofp(index.value, _FLOAT))


def _choose(comparison, x, y):
    like = x if isinstance(x, Vector) else y
    x = like.same(x)
    y = like.same(y)
    return Vector(like.build, like.build.select(like.build.fcmp_ordered(comparison, x, y), x, y))


def minimum(x, y):
    """The smaller; y where one is NaN."""
    return _choose("<", x, y)


def maximum(x, y):
    """The larger; y where one is NaN."""
    return _choose(">", x, y)


def where_greater(p, q, x, y):
    """x where p > q, else y: also where p or q is NaN."""
    like = p if isinstance(p, Vector) else q
    p, q, x, y = (like.same(each) for each in (p, q, x, y))
    return Vector(like.build, like.build.select(like.build.fcmp_ordered(">", p, q), x, y))


def _lane_by_lane(name):
    return lambda x: Vector(x.build, _call(f"llvm.{name}", x))


def _reduced(name, *start, flags=_FUSE):
    return traced(lambda x: _Float(x.build, _call(f"llvm.vector.reduce.{name}", *start, x, flags=flags)))


square_root = _lane_by_lane("sqrt")
absolute = _lane_by_lane("fabs")
floor = _lane_by_lane("floor")
"""Of every lane; the floor is the largest whole number that is not above it."""
least = _reduced("fmin")
largest = _reduced("fmax")
"""Of all lanes, as a number."""
total = _reduced("fadd", ir.Constant(_FLOAT, 0.0), flags=_ADD_ANYHOW)
"""The sum of the lanes."""


def everywhere(number, lanes=LANES):
    """A number that a reduction of lanes gave, in every lane."""
    return narrow(_broadcast(number.build, number.value), lanes)


@traced
def lowest_bit(bits):
    """The number of the lowest 1 of an integer other than 0."""
    return _Index(bits.build, bits.build.cttz(bits.value, ir.Constant(ir.IntType(1), 1)))


def greater_bits(x, y):
    """An integer: 1 << lane for each lane where x > y."""
    bits = x.build.fcmp_ordered(">", x.value, x.same(y))
    return _Index(x.build, x.build.zext(x.build.bitcast(bits, ir.IntType(LANES)), _LONG))


def _picked(x, y, mask):
    y = _undefined(x.lanes) if y is None else y.value
    return Vector(x.build, x.build.shuffle_vector(x.value, y, ir.Constant(_ints(len(mask)), mask)))


def narrow(x, lanes):
    """The first lanes of a vector."""
    return x if lanes == x.lanes else _picked(x, None, list(range(lanes)))


def transposed(rows):
    """LANES vectors as rows of a matrix: its columns."""
    for width in (8, 4, 2, 1):
        out = list(rows)
        for k in range(LANES):
            if k & width == 0:
                # Of both rows: the blocks of `width` lanes with even numbers, those with odd ones.
                for odd, to in ((0, k), (width, k + width)):
                    mask = [(lane & ~width) + odd + (LANES if lane & width else 0) for lane in range(LANES)]
                    out[to] = _picked(rows[k], rows[k + width], mask)
        rows = out
    return rows


def swapped(blocks):
    """Four vectors of four quarters: the first quarters of all in one vector, and so on."""
    swapped_lanes = []
    quarter = LANES // 4
    # The first half of the lanes of one vector, the second half of those of another.
    halves = [*range(LANES // 2), *range(LANES + LANES // 2, 2 * LANES)]
    for k in range(4):
        ours = [k * quarter + lane for lane in range(quarter)]
        pair = [*ours, *(lane + LANES for lane in ours)] * 2
        low = _picked(*blocks[:2], pair)
        high = _picked(*blocks[2:], pair)
        swapped_lanes.append(_picked(low, high, halves))
    return swapped_lanes


def added_in_fours(x):
    """The sum of four neighbouring lanes, in each of them."""
    for step in (1, 2):
        x = x + _picked(x, x, [lane ^ step for lane in range(x.lanes)])
    return x


def sums(values):
    """The sums of the lanes of each of at most LANES vectors, in the lanes of one; what is left over is
    undefined.
    """
    vectors = list(values)
    fours = LANES // 4

    def halve(low, high):
        """Add picked lanes of each pair of vectors: half as many vectors."""
        halved = []
        for k in range(0, len(vectors), 2):
            x = vectors[k]
            y = vectors[k + 1] if k + 1 < len(vectors) else None
            halved.append(_picked(x, y, low) + _picked(x, y, high))
        return halved

    def within_fours(*offsets):
        picked = []
        for g in range(fours):
            picked += [4 * g + offset for offset in offsets]
        return picked

    def every_second_four(first):
        picked = []
        for side in (0, 1):
            for g in range(first, fours, 2):
                picked += [side * LANES + 4 * g + j for j in range(4)]
        return picked

    vectors = halve(within_fours(0, LANES, 1, LANES + 1), within_fours(2, LANES + 2, 3, LANES + 3))
    vectors = halve(within_fours(0, 1, LANES, LANES + 1), within_fours(2, 3, LANES + 2, LANES + 3))
    left = fours
    while left > 1:
        # Group g of a vector holds the partial sums of four of them; the groups of one vector are added in
        # pairs.
        vectors = halve(every_second_four(0), every_second_four(1))
        left = left // 2
    assert len(vectors) == 1
    return vectors[0]


def _polynomial(coefficients, x):
    value = coefficients[-1]
    for each in coefficients[-2::-1]:
        value = value * x + each
    return value


_ROUND = 1.5 * 2**23
"""Added to a small number, the sum's last bits are the rounded number."""
_FITTED_POINTS = 400
"""Chebyshev points that the polynomial of 2^x is fitted to; by eye."""


def _exp2_polynomial(degree):
    """2^x on [-1/2, 1/2]: the polynomial of least relative error, in the mean, at Chebyshev points."""
    points = np.cos(np.pi * (np.arange(_FITTED_POINTS) + 0.5) / _FITTED_POINTS) / 2
    powers = points[:, None] ** np.arange(degree + 1)
    return np.linalg.lstsq(powers / np.exp2(points)[:, None], np.ones(_FITTED_POINTS), rcond=None)[0]


_EXP2 = {degree: _exp2_polynomial(degree) for degree in (3, 5)}
"""Relative error 1.1e-4 and 3e-7."""


def exp2(x, degree=5):
    """2^x for |x| < 126; relative error 3e-7, or 1.1e-4 with degree 3."""
    build = x.build
    lanes = x.lanes
    large = _same(_ROUND, x.lanes)
    # x = n + r with a whole n, the low bits of the sum, and |r| <= 1/2; these two must not be simplified.
    rounded = build.fadd(x.value, large)
    part = Vector(build, build.fsub(x.value, build.fsub(rounded, large)))
    # 2^r by a polynomial; n is added to its exponent.
    value = build.bitcast(_polynomial(_EXP2[degree], part).value, _ints(lanes))
    exponent = build.shl(build.bitcast(rounded, _ints(lanes)), _same_int(23, lanes))
    return Vector(build, build.bitcast(build.add(exponent, value), _floats(lanes)))


# log2(1 + m) / m for 1 + m from 2^-0.5 to 2^0.5, of degree 8: error 3e-7.
_LOG2 = (
    np.polynomial.chebyshev.Chebyshev.interpolate(
        lambda m: np.log2(1 + m) / np.where(np.abs(m) < 1e-9, 1, m), 8, [0.5**0.5 - 1, 2**0.5 - 1]
    )
    .convert(kind=np.polynomial.Polynomial)
    .coef
)


def log2(x):
    """log2 of a positive normal number; error 3e-7 of the larger of 1 and itself."""
    build = x.build
    lanes = x.lanes
    bits = build.bitcast(x.value, _ints(lanes))
    places = _same_int(23, lanes)
    # x = 2^n (1 + m) with 1 + m from 2^-0.5 on: 0x3f3504f3 are the bits of the square root of one half.
    exponent = build.ashr(build.sub(bits, _same_int(0x3F3504F3, lanes)), places)
    part = Vector(build, build.bitcast(build.sub(bits, build.shl(exponent, places)), _floats(lanes))) - 1.0
    return _polynomial(_LOG2, part) * part + Vector(build, build.sitofp(exponent, _floats(lanes)))
