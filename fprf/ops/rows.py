"""Elementwise steps of compiled kernels, WIDE numbers at a time: indices that a compiler cannot prove to be positive keep it
from using vectors by itself.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc, untyped-decorator, call-arg"

from numba import types
from numba.extending import intrinsic

from .lanes import WIDE, address, constant, load, store

__all__ = ["add_lanes", "copy_lanes", "mask_lanes"]


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


@intrinsic
def mask_lanes(typing, x, at, gate, g_at, out, to):
    """out = x where gate > 0, else 0."""
    signature = types.void(x, at, gate, g_at, out, to)

    def generate(context, build, signature, args):
        x, at, gate, g_at, out, to = args
        value = load(build, address(context, build, signature.args[0], x, at), WIDE)
        opened = load(build, address(context, build, signature.args[2], gate, g_at), WIDE)
        zero = constant(0.0, WIDE)
        passed = build.select(build.fcmp_ordered(">", opened, zero), value, zero)
        store(build, passed, address(context, build, signature.args[4], out, to))
        return context.get_dummy_value()

    return signature, generate
