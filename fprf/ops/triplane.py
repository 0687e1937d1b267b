"""Tri-plane lookup (K-Planes): for every scale the product over three planes of a bilinear sample, scales
side by side.

Conventions. Points lie in [-1, 1]^3; the outer nodes of a plane sit on -1 and 1, so neighbouring blocks that
share an edge agree on it. A point outside takes the value at the border. Plane p spans the axes AXES[p]. All
scales of all planes live in one table [rows, channels] of channel vectors: scale after scale, plane after
plane, row v after row, node u after node. One table means one parameter, one optimiser state and one pass.

The torch form is the reference for every device and dtype; in float32 fused kernels take over: on the CPU
`triplane_kernels`, compiled by numba on first use and cached, on CUDA `triplane_triton`, compiled by Triton.
All keep coordinates and arithmetic in the dtype of the points, never half (half coordinates cost 3.5e-2 of
the feature at 512 nodes). Gradients go to the table, and to points that ask for them (poses that are
refined). A sample has a kink at each node: there its slope is that of the cell above.
"""

# The checker takes compiled functions to have one argument.
# mypy: disable-error-code="call-arg"

import functools
import importlib.util
import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from .backend import compiled, compiled_for
from .dense import array

AXES = ((0, 1), (0, 2), (1, 2))
"""Axes that each plane spans, along its rows first."""
_LANES = 8
"""Channels of the kernels' vectors."""
_GRADIENT_SLICES = 4
"""Parts of the points whose gradients are summed apart; by eye."""
_MAX_SLICED_NUMBERS = 2**19
"""Numbers of a table up to which that is worth the memory: 2 MiB a part; by eye."""


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
            u = part[:, a, None]
            v = part[:, b, None]
            i = node[:, b]
            j = node[:, a]
            value = (plane[i, j] * (1 - u) + plane[i, j + 1] * u) * (1 - v)
            value = value + (plane[i + 1, j] * (1 - u) + plane[i + 1, j + 1] * u) * v
            product = value if product is None else product * value
        assert product is not None
        scales.append(product)
    return torch.cat(scales, -1)


def variation_reference(table: Annotated[Tensor, "rows F"], resolutions: Sequence[int]) -> Tensor:
    """Mean squared difference of neighbouring nodes, summed over both directions and all scales: a scalar."""
    total = table.new_zeros(())
    for grid in split(table, resolutions):
        across = grid[:, :, 1:] - grid[:, :, :-1]
        down = grid[:, 1:] - grid[:, :-1]
        total = total + across.square().mean() + down.square().mean()
    return total


def usable(points: Tensor, table: Tensor) -> bool:
    """Return whether kernels apply: float32 on the CPU, whole vectors of channels, and numba is installed."""
    return compiled_for(points, table) and table.shape[1] % _LANES == 0


def triton_usable(points: Tensor, table: Tensor) -> bool:
    """Return whether Triton's kernels apply: float32 on one CUDA device for which it can compile."""
    device = points.device
    if (
        device.type != "cuda"
        or table.device != device
        or points.dtype != torch.float32
        or table.dtype != torch.float32
    ):
        return False
    return compiled() and _compiles(device)


@functools.cache
def _compiles(device: torch.device) -> bool:
    """True where a kernel can be compiled and launched: tried once, and told where it cannot."""
    if importlib.util.find_spec("triton") is None or not torch.cuda.is_available():
        return False
    from . import triplane_triton as kernels

    try:
        kernels.forward(torch.zeros(1, 3, device=device), torch.zeros(12, 1, device=device), (2,))
    except torch.OutOfMemoryError:
        raise
    except Exception as error:  # whatever a compiler, a linker or a driver raises
        reason = (str(error).splitlines() or [""])[0]
        warnings.warn(
            f"Triton cannot compile for {device} ({type(error).__name__}: {reason}): tri-planes run in plain torch, slower; "
            "install a C compiler and Python's headers (apt install gcc python3-dev)",
            stacklevel=2,
        )
        return False
    return True


class HeldGradient:
    """Memory for the gradient of a large table on the CPU that outlives a step, so that the system need not
    hand out and clear the same pages in each.

    Kernels that are given it add to `table.grad` themselves, and tell autograd of no gradient. It is zero
    between steps: whoever has used a gradient calls `clear`.
    """

    def __init__(self, table: Tensor) -> None:
        self.table = table
        self._memory: Tensor | None = None

    def gradient(self) -> Annotated[Tensor, "rows F"]:
        """The gradient of the table to add to: as it is, or zeros, which become its `grad`."""
        if self.table.grad is None:
            if self._memory is None:
                self._memory = torch.zeros_like(self.table, memory_format=torch.contiguous_format)
            self.table.grad = self._memory
        return self.table.grad

    def clear(self) -> None:
        """Set the gradient to zero, and the `grad` of the table to None."""
        if self.table.grad is not None and self.table.grad is self._memory:
            self._memory.zero_()
        self.table.grad = None


def held(table: Tensor) -> HeldGradient | None:
    """Memory for a table's gradient; None where the table is too small to gain by it, or not on the CPU."""
    if table.numel() > _MAX_SLICED_NUMBERS and table.device.type == "cpu":
        return HeldGradient(table)
    return None


def lookup(
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
    gradient: HeldGradient | None = None,
) -> Annotated[Tensor, "N scales*F"]:
    """The fastest form that this device and dtype have; equal to the reference within 4u (r |slope| + 3
    |value|).

    Where a kernel computes the table's gradient on the CPU it is added to the one held.
    """
    if not (usable(points, table) or triton_usable(points, table)):
        return lookup_reference(points, table, resolutions)
    result: Tensor = _Lookup.apply(points.contiguous(), table, tuple(resolutions), gradient)  # type: ignore[no-untyped-call]
    return result


def weighed(
    points: Annotated[Tensor, "N 3"],
    table: Annotated[Tensor, "rows F"],
    resolutions: Sequence[int],
    weight: Annotated[Tensor, "scales*F"],
    *,
    limit: float,
) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N scales*F"]]:
    """exp(min(value . weight - 1, limit)) and the values of `lookup`, in one pass, without gradients.

    Where `usable`. The exponent errs as a sum of scales*F products, the exponential by 4e-7 of itself.
    """
    from . import triplane_kernels as kernels

    values = torch.empty(len(points), len(resolutions) * table.shape[1])
    density = torch.empty(len(points))
    numbers, _, sizes, starts = _laid_out(table, resolutions)
    limited = torch.nn.functional.pad(weight.detach(), (0, 1), value=limit)
    kernels.weighed(
        array(points), numbers, sizes, starts, array(limited), values.view(-1).numpy(), density.numpy()
    )
    return density, values


def variation(
    table: Annotated[Tensor, "rows F"], resolutions: Sequence[int], gradient: HeldGradient | None = None
) -> Tensor:
    """`variation_reference`, fused and accumulated in float64 where the device has it; the gradient as that of
    `lookup`.
    """
    if not usable(table, table):
        return variation_reference(table, resolutions)
    result: Tensor = _Variation.apply(table, tuple(resolutions), gradient)  # type: ignore[no-untyped-call]
    return result


class _Lookup(torch.autograd.Function):
    """On the CPU forward runs over points, and backward over (scale, group of channels): no two tasks write
    the same number, so no locks, and the sum over points has one order: bitwise the same for any number of
    threads.
    """

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        resolutions: tuple[int, ...],
        gradient: HeldGradient | None,
    ) -> Tensor:
        ctx.save_for_backward(points, table)
        ctx.resolutions = resolutions
        ctx.gradient = gradient
        if points.is_cuda:
            from . import triplane_triton

            return triplane_triton.forward(points, table.detach().contiguous(), resolutions)
        from . import triplane_kernels as kernels

        out = torch.empty(len(points), len(resolutions) * table.shape[1])
        kernels.forward(array(points), *_laid_out(table, resolutions), out.view(-1).numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        points, table = ctx.saved_tensors
        to_points = to_table = None
        if points.is_cuda:
            from . import triplane_triton

            if ctx.needs_input_grad[0]:
                with torch.enable_grad():
                    given = points.detach().requires_grad_()
                    value = lookup_reference(given, table.detach(), ctx.resolutions)
                (to_points,) = torch.autograd.grad(value, given, grads[0])
            if ctx.needs_input_grad[1]:
                to_table = triplane_triton.backward(
                    points, table.detach().contiguous(), ctx.resolutions, grads[0]
                )
            return to_points, to_table, None, None
        from . import triplane_kernels as kernels

        given = array(points), *_laid_out(table, ctx.resolutions), array(grads[0])
        if ctx.needs_input_grad[0]:
            to_points = torch.empty(len(points), 3)
            kernels.point_slopes(*given, to_points.view(-1).numpy())
        if ctx.needs_input_grad[1] and ctx.gradient is not None:
            kernels.backward(*given, 1, array(ctx.gradient.gradient()))
        elif ctx.needs_input_grad[1]:
            # A table of few scales gives few tasks, so a small one is summed up in parts. Sizes alone decide:
            # the order of the sums must not depend on the machine.
            slices = (
                _GRADIENT_SLICES
                if table.numel() <= _MAX_SLICED_NUMBERS and grads[0].numel() > table.numel()
                else 1
            )
            parts = torch.zeros(slices, *table.shape)
            kernels.backward(*given, slices, parts.view(-1).numpy())
            to_table = parts.sum(0) if slices > 1 else parts[0]
        return to_points, to_table, None, None


class _Variation(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, table: Tensor, resolutions: tuple[int, ...], gradient: HeldGradient | None
    ) -> Tensor:
        from . import triplane_kernels as kernels

        ctx.save_for_backward(table)
        ctx.resolutions = resolutions
        ctx.gradient = gradient
        return torch.tensor(kernels.variation(*_laid_out(table, resolutions)), dtype=table.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, None, None]:
        from . import triplane_kernels as kernels

        (table,) = ctx.saved_tensors
        given = (*_laid_out(table, ctx.resolutions), float(grads[0]))
        if ctx.gradient is not None:
            kernels.variation_gradient(*given, array(ctx.gradient.gradient()))
            return None, None, None
        out = torch.zeros_like(table, memory_format=torch.contiguous_format)
        kernels.variation_gradient(*given, out.view(-1).numpy())
        return out, None, None


def _laid_out(table: Tensor, resolutions: Sequence[int]) -> tuple[Any, ...]:
    """A table, its channels, and nodes a side and first row of every scale, as kernels take them."""
    sizes = np.asarray(resolutions, dtype=np.int64)
    starts = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(3 * sizes * sizes)[:-1]])
    return array(table), table.shape[1], sizes, starts
