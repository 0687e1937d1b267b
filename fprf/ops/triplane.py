"""Tri-plane lookup (K-Planes): for every scale the product over three planes of a bilinear sample, scales side by side.

Conventions. Points lie in [-1, 1]^3; the outer nodes of a plane sit on -1 and 1, so neighbouring blocks that share an edge
agree on it. A point outside takes the value at the border. Plane p spans the axes AXES[p]. All scales of all planes live
in one table [rows, channels] of channel vectors: scale after scale, plane after plane, row v after row, node u after node.
One table means one parameter, one optimiser state and one pass.

The torch form is the reference for every device and dtype; in float32 fused kernels take over, those of `triplane_numba` on
the CPU and those of `triplane_triton` on a GPU. All keep coordinates and arithmetic in the dtype of the points, never half
(half coordinates cost 3.5e-2 of the feature at 512 nodes); a table that nobody trains may be stored in half. Gradients go to
the table, and to points that ask for them (poses that are refined); on a GPU the latter are found in the plain form. A sample
has a kink at each node: there its slope is that of the cell above.
"""

from collections.abc import Sequence
from typing import Annotated, Any

import torch
from torch import Tensor

from . import triplane_numba, triplane_triton

AXES = ((0, 1), (0, 2), (1, 2))


def rows(resolutions: Sequence[int]) -> int:
    """Rows of the table of planes at these resolutions."""
    return sum(len(AXES) * r * r for r in resolutions)


def split(table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> list[Tensor]:
    """Views [3 r r F] of the table, one a scale."""
    parts = torch.split(table, [len(AXES) * r * r for r in resolutions])
    return [p.view(len(AXES), r, r, table.shape[1]) for p, r in zip(parts, resolutions, strict=True)]


def lookup_reference(
    points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> Annotated[Tensor, "N scales*F"]:
    """The plain form: four gathers a plane, differentiable in table and points by autograd."""
    scales = []
    for planes, r in zip(split(table, resolutions), resolutions, strict=True):
        # NaN falls on the lower border, as in the fused form: an index must never leave the table.
        at = ((points + 1) * (0.5 * (r - 1))).clamp(0, r - 1).nan_to_num(0.0)
        low = at.floor().clamp(max=r - 2)
        part = at - low
        node = low.long()
        product: Tensor | None = None
        for plane, (a, b) in zip(planes, AXES, strict=True):
            u, v = part[:, a, None], part[:, b, None]
            i, j = node[:, b], node[:, a]
            value = (plane[i, j] * (1 - u) + plane[i, j + 1] * u) * (1 - v)
            value = value + (plane[i + 1, j] * (1 - u) + plane[i + 1, j + 1] * u) * v
            product = value if product is None else product * value
        assert product is not None
        scales.append(product)
    return torch.cat(scales, -1)


def point_slopes_reference(
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
    grad: Annotated[Tensor, "N scales*F"],
) -> Annotated[Tensor, "N 3"]:
    """Gradient of the points for one of the features, in the plain form; 0 along an axis on which a point lies outside."""
    with torch.enable_grad():
        given = points.detach().requires_grad_()
        (slopes,) = torch.autograd.grad(lookup_reference(given, table.detach(), resolutions), given, grad)
    return slopes


def variation_reference(table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> Tensor:
    """Mean squared difference of neighbouring nodes, summed over both directions and all scales: a scalar."""
    total = table.new_zeros(())
    for grid in split(table, resolutions):
        across, down = grid[:, :, 1:] - grid[:, :, :-1], grid[:, 1:] - grid[:, :-1]
        total = total + across.square().mean() + down.square().mean()
    return total


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, resolutions: tuple[int, ...], kernels: Any) -> Tensor:
        ctx.save_for_backward(points, table)
        ctx.resolutions, ctx.kernels = resolutions, kernels
        result: Tensor = kernels.forward(points, table, resolutions)
        return result

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        points, table = ctx.saved_tensors
        to_points, to_table, given = None, None, (points, table, ctx.resolutions, grads[0].contiguous())
        if ctx.needs_input_grad[0]:
            to_points = (triplane_numba.point_slopes if ctx.kernels is triplane_numba else point_slopes_reference)(*given)
        if ctx.needs_input_grad[1]:
            to_table = ctx.kernels.backward(*given)
        return to_points, to_table, None, None


def lookup(
    points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> Annotated[Tensor, "N scales*F"]:
    """The fastest form that this device and dtype have; equal to the reference within 4u (r |slope| + 3 |value|)."""
    for kernels in (triplane_triton, triplane_numba):
        if kernels.usable(points, table):
            result: Tensor = _Lookup.apply(points.contiguous(), table, tuple(resolutions), kernels)  # type: ignore[no-untyped-call]
            return result
    return lookup_reference(points, table, resolutions)


class _Variation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, resolutions: tuple[int, ...]) -> Tensor:
        ctx.save_for_backward(table)
        ctx.resolutions = resolutions
        return triplane_numba.variation(table, resolutions)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (table,) = ctx.saved_tensors
        return triplane_numba.variation_gradient(table, ctx.resolutions, float(grads[0])), None


def variation(table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> Tensor:
    """`variation_reference`, fused where the device has it."""
    if not triplane_numba.usable(table, table):
        return variation_reference(table, resolutions)
    result: Tensor = _Variation.apply(table, tuple(resolutions))  # type: ignore[no-untyped-call]
    return result
