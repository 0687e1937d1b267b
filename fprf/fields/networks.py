"""Small networks without biases, and their deterministic start."""

import math

import torch
from torch import Tensor, nn

__all__ = ["linear", "mlp", "weights"]


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
