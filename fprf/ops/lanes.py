"""Vectors of float32 for compiled kernels, as building blocks of LLVM code.

Left to itself the compiler keeps most of our inner loops scalar (it cannot prove that their arrays do not overlap), so they
are written as explicit vector instructions. Only multiply-add fusion is allowed: no re-association, so a result does not
depend on the width of the machine's vectors, but for that fusion.

exp and 1 - exp(-x):  x = n ln 2 + r,  |r| <= ln 2 / 2,  e^x - 1 = 2^n p + (2^n - 1)  with  p = e^r - 1 by its series to r^7.
The series' remainder is below 5e-9 |p|, so p errs by about one unit round-off and so do the functions (at most 3u, u = 2^-24).
NaN stays NaN; exp is 0 below -87.33 and infinite above 88.3, where 2^n would leave float32's normal range.

The inner step of the tri-plane kernels takes several channels at a time: left to the compiler it is 3 times slower on
196 608 points, forward and backward. Its offsets are in numbers from the start of flat arrays; `step` and `stride` lead to
the next node along the row and to the next row.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

import math

from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic


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


LANES = 8
"""Channels come in groups of so many: one AVX register of float32. `_wide` takes WIDE at once."""


def _corners(context, build, kind, array, base, step, stride):
    down = build.add(base, stride)
    offsets = (base, build.add(base, step), down, build.add(down, step))
    return [address(context, build, kind, array, offset) for offset in offsets]


def _shares(build, parts, lanes):
    """Of each coordinate what the lower and the upper node get."""
    one = ir.Constant(_FLOAT, 1.0)
    return [(splat(build, build.fsub(one, part), lanes), splat(build, part, lanes)) for part in parts]


def _mix(build, low, high, share):
    return build.fadd(build.fmul(low, share[0], flags=FUSE), build.fmul(high, share[1], flags=FUSE), flags=FUSE)


def _planes(build, kind, context, table, bases, step, stride, parts, lanes):
    """Bilinear samples of the three planes, along the rows first, and the shares of the nodes of each."""
    u, v, w = _shares(build, parts, lanes)
    values, pairs = [], ((u, v), (u, w), (v, w))
    for base, (across, down) in zip(bases, pairs, strict=True):
        corners = [load(build, p, lanes) for p in _corners(context, build, kind, table, base, step, stride)]
        rows = [_mix(build, *corners[first : first + 2], across) for first in (0, 2)]
        values.append(_mix(build, *rows, down))
    return values, pairs


def _forward(lanes):
    @intrinsic
    def product_forward(typing, table, out, a, b, c, o, step, stride, u, v, w):
        """out[o : o+lanes] = sample(a; u, v) * sample(b; u, w) * sample(c; v, w)."""
        signature = types.void(table, out, a, b, c, o, step, stride, u, v, w)

        def generate(context, build, signature, args):
            table, out, a, b, c, o, step, stride, u, v, w = args
            (x, y, z), _ = _planes(build, signature.args[0], context, table, (a, b, c), step, stride, (u, v, w), lanes)
            store(build, build.fmul(build.fmul(x, y), z), address(context, build, signature.args[1], out, o))
            return context.get_dummy_value()

        return signature, generate

    return product_forward


def _backward(lanes):
    @intrinsic
    def product_backward(typing, table, grad, out, a, b, c, o, shift, step, stride, u, v, w):
        """Add to out[shift:], at the corners of a, b and c, the gradient of `product_forward` for grad[o : o+lanes]."""
        signature = types.void(table, grad, out, a, b, c, o, shift, step, stride, u, v, w)

        def generate(context, build, signature, args):
            table, grad, out, a, b, c, o, shift, step, stride, u, v, w = args
            (x, y, z), pairs = _planes(build, signature.args[0], context, table, (a, b, c), step, stride, (u, v, w), lanes)
            g = load(build, address(context, build, signature.args[1], grad, o), lanes)
            shares = (
                build.fmul(build.fmul(g, y), z),
                build.fmul(build.fmul(g, x), z),
                build.fmul(build.fmul(g, x), y),
            )
            for base, (across, down), share in zip((a, b, c), pairs, shares, strict=True):
                pointers = _corners(context, build, signature.args[2], out, build.add(base, shift), step, stride)
                rows = [build.fmul(share, each) for each in down]
                for pointer, row, column in zip(pointers, (rows[0], rows[0], rows[1], rows[1]), across * 2, strict=True):
                    part = build.fmul(row, column, flags=FUSE)
                    store(build, build.fadd(load(build, pointer, lanes), part, flags=FUSE), pointer)
            return context.get_dummy_value()

        return signature, generate

    return product_backward


@intrinsic
def product_slopes(typing, table, grad, sums, a, b, c, o, step, stride, u, v, w):
    """Add to sums[0], [LANES] and [2 LANES] onwards grad[o :] times the slopes of `product_forward` along u, v and w."""
    signature = types.void(table, grad, sums, a, b, c, o, step, stride, u, v, w)

    def generate(context, build, signature, args):
        table, grad, sums, a, b, c, o, step, stride, u, v, w = args
        shares = _shares(build, (u, v, w), LANES)
        values, slopes = [], []
        for base, across, down in zip((a, b, c), (0, 0, 1), (1, 2, 2), strict=True):
            places = _corners(context, build, signature.args[0], table, base, step, stride)
            corners = [load(build, place, LANES) for place in places]
            rows = [_mix(build, *corners[first : first + 2], shares[across]) for first in (0, 2)]
            rises = [build.fsub(corners[first + 1], corners[first]) for first in (0, 2)]
            values.append(_mix(build, *rows, shares[down]))
            slopes.append({across: _mix(build, *rises, shares[down]), down: build.fsub(rows[1], rows[0])})
        x, y, z = values
        g = load(build, address(context, build, signature.args[1], grad, o), LANES)
        others = (build.fmul(y, z), build.fmul(x, z), build.fmul(x, y))
        for axis in range(3):
            parts = [build.fmul(s[axis], rest, flags=FUSE) for s, rest in zip(slopes, others, strict=True) if axis in s]
            place = address(context, build, signature.args[2], sums, number(axis * LANES))
            total = build.fmul(g, build.fadd(*parts, flags=FUSE), flags=FUSE)
            store(build, build.fadd(load(build, place, LANES), total, flags=FUSE), place)
        return context.get_dummy_value()

    return signature, generate


product_forward, product_backward = _forward(LANES), _backward(LANES)
product_forward_wide, product_backward_wide = _forward(WIDE), _backward(WIDE)


@intrinsic
def scaled(typing, x, x_at, factor, y, y_at, out, to):
    """out[to : to + LANES] = y[y_at :] + factor * x[x_at :]."""
    signature = types.void(x, x_at, types.float32, y, y_at, out, to)

    def generate(context, build, signature, args):
        x, x_at, factor, y, y_at, out, to = args
        many = load(build, address(context, build, signature.args[0], x, x_at), LANES)
        more = load(build, address(context, build, signature.args[3], y, y_at), LANES)
        product = build.fmul(many, splat(build, factor, LANES), flags=FUSE)
        store(build, build.fadd(more, product, flags=FUSE), address(context, build, signature.args[5], out, to))
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def dot(typing, x, x_at, y, y_at, count):
    """Sum of x[x_at + i] * y[y_at + i] over i < count, a multiple of LANES: lanes first, then halves of them."""
    signature = types.float32(x, x_at, y, y_at, count)

    def generate(context, build, signature, args):
        x, x_at, y, y_at, count = args
        left, right = address(context, build, signature.args[0], x, x_at), address(context, build, signature.args[2], y, y_at)
        long = ir.IntType(64)
        before, loop, after = build.block, build.append_basic_block("sum"), build.append_basic_block("done")
        build.branch(loop)
        build.position_at_end(loop)
        kind = ir.VectorType(_FLOAT, LANES)
        i, total = build.phi(long), build.phi(kind)
        part = build.fmul(load(build, build.gep(left, [i]), LANES), load(build, build.gep(right, [i]), LANES), flags=FUSE)
        added, following = build.fadd(total, part, flags=FUSE), build.add(i, ir.Constant(long, LANES))
        i.add_incoming(ir.Constant(long, 0), before)
        i.add_incoming(following, loop)
        total.add_incoming(ir.Constant(kind, [0.0] * LANES), before)
        total.add_incoming(added, loop)
        build.cbranch(build.icmp_signed("<", following, count), loop, after)
        build.position_at_end(after)
        width = LANES
        while width > 1:
            width //= 2
            index = [
                ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(first, first + width))) for first in (0, width)
            ]
            halves = [build.shuffle_vector(added, ir.Constant(added.type, ir.Undefined), half) for half in index]
            added = build.fadd(*halves)
        return build.extract_element(added, ir.Constant(ir.IntType(32), 0))

    return signature, generate
