"""Vectors of float32 for compiled kernels, as building blocks of LLVM code.

Left to itself the compiler keeps most of our inner loops scalar (it cannot prove that their arrays do not overlap), so they
are written as explicit vector instructions. Only multiply-add fusion is allowed: no re-association, so a result does not
depend on the width of the machine's vectors, but for that fusion.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc"

from llvmlite import binding, ir

__all__ = ["BLOCK", "FUSE", "WIDE", "address", "constant", "load", "number", "splat", "store", "vector"]


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
