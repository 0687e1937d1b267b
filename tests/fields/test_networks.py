"""Small networks: shapes, seeds, and a start that keeps the variance."""

import pytest
import torch

from fprf.fields.planes import linear, mlp


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("inputs", [1, 16, 300])
def test_a_linear_map_keeps_unit_variance(inputs: int) -> None:
    layer = linear(inputs, 20_000 // inputs + 50, generator=draw())
    assert layer.bias is None
    bound = (3 / inputs) ** 0.5
    assert layer.weight.abs().max() <= bound and layer.weight.abs().max() >= 0.95 * bound
    # The variance of 20 000 uniform draws is known to 1 in 100; four standard errors of (1 / inputs) sqrt(0.8 / n).
    variance = layer.weight.square().mean().item() * inputs
    assert abs(variance - 1) <= 4 * (0.8 / layer.weight.numel()) ** 0.5


@pytest.mark.parametrize("layers", [1, 2, 5])
def test_a_network_keeps_the_scale_through_its_layers(layers: int) -> None:
    network = mlp(256, 256, layers, 256, generator=draw())
    out = network(torch.randn(500, 256, generator=draw(1)))
    # Each hidden layer keeps the mean square; the last one, after a ReLU, of values of mean square 1.
    assert 0.6 < out.square().mean().item() < 1.6
