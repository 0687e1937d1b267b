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

import math
from collections.abc import Sequence
from typing import Annotated, Any, Protocol

import torch
from torch import Tensor

from . import triplane_numba, triplane_triton

__all__ = [
    "AXES",
    "density",
    "density_alone",
    "fused",
    "lookup",
    "lookup_reference",
    "point_slopes_reference",
    "rows",
    "split",
    "variation",
    "variation_reference",
]

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
        (found,) = torch.autograd.grad(lookup_reference(given, table.detach(), resolutions), given, grad)
    return found


def variation_reference(table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> Tensor:
    """Mean squared difference of neighbouring nodes, summed over both directions and all scales: a scalar."""
    total = table.new_zeros(())
    for grid in split(table, resolutions):
        across, down = grid[:, :, 1:] - grid[:, :, :-1], grid[:, 1:] - grid[:, :-1]
        total = total + across.square().mean() + down.square().mean()
    return total


class _Form(Protocol):
    """Fused kernels of one kind of device: `triplane_numba`, `triplane_triton`."""

    def forward(self, points: Tensor, table: Tensor, resolutions: Sequence[int]) -> Tensor: ...

    def density(
        self, points: Tensor, table: Tensor, resolutions: Sequence[int], weight: Tensor, limit: float, *, keep: bool
    ) -> tuple[Tensor, Tensor]: ...

    def backward(
        self,
        points: Tensor,
        table: Tensor,
        resolutions: Sequence[int],
        grad: Tensor | None,
        raw: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Tensor: ...

    def summed(self, raw: Tensor, latent: Tensor) -> Tensor: ...


def _form(points: Tensor, table: Tensor) -> _Form | None:
    if triplane_triton.usable(points, table):
        return triplane_triton
    return triplane_numba if triplane_numba.usable(points, table) else None


def _point_slopes(
    form: _Form,
    points: Tensor,
    table: Tensor,
    resolutions: Sequence[int],
    grad: Tensor | None,
    raw: Tensor | None,
    weight: Tensor | None,
) -> Tensor:
    """Gradient of the points for the features' gradient grad + raw weight; what is None is not added."""
    if form is triplane_numba:
        return triplane_numba.point_slopes(points, table, resolutions, grad, raw, weight)
    parts = [] if grad is None else [grad]
    if raw is not None and weight is not None:
        parts.append(raw[:, None] * weight)
    return point_slopes_reference(points, table, resolutions, torch.stack(parts).sum(0))


def fused(points: Tensor, table: Tensor) -> bool:
    """Whether `density` and `density_alone` may be called: there are kernels for this device and these dtypes."""
    return _form(points, table) is not None


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, resolutions: tuple[int, ...], form: _Form) -> Tensor:
        ctx.save_for_backward(points, table)
        ctx.resolutions, ctx.form = resolutions, form
        return form.forward(points, table, resolutions)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        points, table = ctx.saved_tensors
        to_points, to_table, grad = None, None, grads[0].contiguous()
        if ctx.needs_input_grad[0]:
            to_points = _point_slopes(ctx.form, points, table, ctx.resolutions, grad, None, None)
        if ctx.needs_input_grad[1]:
            to_table = ctx.form.backward(points, table, ctx.resolutions, grad)
        return to_points, to_table, None, None


class _Density(torch.autograd.Function):
    """Density and features together: neither the features' gradient nor its sum with the density's is ever written."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, resolutions: tuple[int, ...], weight: Tensor, limit: float, form: _Form
    ) -> tuple[Tensor, Tensor]:
        density, latent = form.density(points, table, resolutions, weight, limit, keep=True)
        ctx.save_for_backward(points, table, weight, density, latent)
        ctx.resolutions, ctx.limit, ctx.form = resolutions, limit, form
        ctx.set_materialize_grads(False)
        return density, latent

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, Tensor | None, None, Tensor | None, None, None]:
        points, table, weight, density, latent = ctx.saved_tensors
        thick, feature = grads
        if thick is None and feature is None:
            return None, None, None, None, None, None
        # As `exp_gradient`: no gradient explodes or dies where the density is cut off.
        raw = None if thick is None else thick * density.clamp_min(math.exp(-ctx.limit))
        given, needs = (points, table, ctx.resolutions, feature, raw, weight), ctx.needs_input_grad
        to_points = _point_slopes(ctx.form, *given) if needs[0] else None
        to_table = ctx.form.backward(*given) if needs[1] else None
        to_weight = ctx.form.summed(raw, latent) if needs[3] and raw is not None else None
        return to_points, to_table, None, to_weight, None, None


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


def lookup(
    points: Annotated[Tensor, "N 3"], table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]
) -> Annotated[Tensor, "N scales*F"]:
    """The fastest form that this device and dtype have; equal to the reference within 4u (r |slope| + 3 |value|)."""
    form = _form(points, table)
    if form is None:
        return lookup_reference(points, table, resolutions)
    result: Tensor = _Lookup.apply(points.contiguous(), table, tuple(resolutions), form)  # type: ignore[no-untyped-call]
    return result


def density(
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
    weight: Annotated[Tensor, "scales*F"],
    limit: float,
) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N scales*F"]]:
    """exp(min(feature . weight - 1, limit)), and the features of `lookup`, where kernels are `fused`.

    The gradient of the density is that of exp between -limit and limit, and the one at the nearer of them beyond.
    """
    form, given = _form(points, table), points.contiguous()
    assert form is not None, "callers ask `fused`"
    found: tuple[Tensor, Tensor] = _Density.apply(given, table, tuple(resolutions), weight, limit, form)  # type: ignore[no-untyped-call]
    return found


def density_alone(
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
    weight: Annotated[Tensor, "scales*F"],
    limit: float,
) -> Annotated[Tensor, "N"]:
    """The density of `density` without gradients: features are summed up as they are found."""
    form = _form(points, table)
    assert form is not None, "callers ask `fused`"
    return form.density(points.detach().contiguous(), table, resolutions, weight, limit, keep=False)[0]


def variation(table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> Tensor:
    """`variation_reference`, fused where the device has it."""
    if not triplane_numba.usable(table, table):
        return variation_reference(table, resolutions)
    result: Tensor = _Variation.apply(table, tuple(resolutions))  # type: ignore[no-untyped-call]
    return result
