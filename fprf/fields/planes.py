"""Learned tri-planes (`ops.triplane`) as a module, and what fields put on them: densities, small networks, harmonics."""

import math
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from torch import Tensor, nn

from ..errors import ConfigError
from ..ops import triplane

__all__ = ["LIMIT", "MAX_DEGREE", "Planes", "count", "density", "harmonics", "linear", "mlp", "weights"]


LIMIT = 15.0
"""exp(15) = 3e6 per space unit is opaque within a micro-unit; beyond it only the gradient could overflow."""


class _Exp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(max=LIMIT).exp()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        result: Tensor = grads[0] * x.clamp(-LIMIT, LIMIT).exp()
        return result


def density(raw: Annotated[Tensor, "N"]) -> Annotated[Tensor, "N"]:
    """exp(raw - 1), capped at exp(15): the start is thin, so that light reaches the whole scene (K-Planes)."""
    result: Tensor = _Exp.apply(raw - 1)  # type: ignore[no-untyped-call]
    return result


def linear(inputs: int, outputs: int, *, generator: torch.Generator) -> nn.Linear:
    """A linear map without bias, uniform in +-sqrt(3 / inputs): unit variance out for unit variance in."""
    layer = nn.Linear(inputs, outputs, bias=False)
    bound = math.sqrt(3 / inputs)
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
    return layer


def mlp(inputs: int, hidden: int, layers: int, outputs: int, *, generator: torch.Generator) -> nn.Sequential:
    """`layers` hidden ReLU layers of width `hidden`, then a linear one; hidden weights keep the variance through ReLU."""
    parts: list[nn.Module] = []
    for _ in range(layers):
        layer = linear(inputs, hidden, generator=generator)
        with torch.no_grad():
            layer.weight.mul_(math.sqrt(2))
        parts += [layer, nn.ReLU(inplace=True)]
        inputs = hidden
    parts.append(linear(inputs, outputs, generator=generator))
    return nn.Sequential(*parts)


def weights(network: nn.Sequential) -> list[Tensor]:
    """Of each linear map, [outputs, inputs]."""
    return [layer.weight for layer in network if isinstance(layer, nn.Linear)]


MAX_DEGREE = 4


def count(degree: int) -> int:
    """Number of functions of a degree: its square. Raises ConfigError outside 1..4."""
    if not 1 <= degree <= MAX_DEGREE:
        raise ConfigError(f"degree: {degree} must lie in [1, {MAX_DEGREE}]")
    return degree * degree


def harmonics(view: Annotated[Tensor, "N 3"], degree: int) -> Annotated[Tensor, "N degree**2"]:
    """Values at unit directions."""
    x, y, z = view.unbind(-1)
    columns = [torch.full_like(x, 0.28209479177387814)]
    if degree > 1:
        columns += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree > 2:
        columns += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree > 3:
        columns += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, -1)


class Planes(nn.Module):
    """Points of the unit cube to `out` = scales x channels features."""

    def __init__(self, resolutions: Sequence[int], channels: int, *, generator: torch.Generator) -> None:
        super().__init__()
        self.resolutions = tuple(resolutions)
        self.out = len(self.resolutions) * channels
        # Positive start (K-Planes): a product of three zero-mean planes would start with no signal and no gradient.
        table = torch.empty(triplane.rows(self.resolutions), channels).uniform_(0.1, 0.5, generator=generator)
        self.table = nn.Parameter(table)

    def forward(self, points: Annotated[Tensor, "N 3"]) -> Annotated[Tensor, "N out"]:
        """Features, coarse scales first."""
        return triplane.lookup(points, self.table, self.resolutions)

    def density(
        self, points: Annotated[Tensor, "N 3"], weight: Annotated[Tensor, "out"]
    ) -> tuple[Annotated[Tensor, "N"], Annotated[Tensor, "N out"]]:
        """`fields.density` of the features' product with the weight, and the features."""
        latent = self(points)
        return density(latent @ weight), latent

    def variation(self) -> Tensor:
        """Total variation: mean squared difference of neighbouring nodes, summed over scales."""
        return triplane.variation(self.table, self.resolutions)
