"""Adam on large tables: the kernel against float64, and the plain form against torch's own."""

import math

import pytest
import torch
from torch import Tensor, nn

from fprf.ops import adam, backend
from fprf.ops.adam import AdamStep, Moments

U = 2.0**-24
"""Unit round-off of float32."""
COUNTS = (16, 16 * 1025, 2**14 + 64)


def drawn(count: int, dtype: torch.dtype = torch.float32) -> list[Tensor]:
    """A parameter, its gradient over many orders, and moments; some were never seen."""
    draw = torch.Generator().manual_seed(count)
    parameter = torch.randn(count, generator=draw)
    gradient = torch.randn(count, generator=draw) * torch.rand(count, generator=draw) ** 8
    first = 0.1 * torch.randn(count, generator=draw)
    second = torch.rand(count, generator=draw) ** 9 + 1e-6
    gradient[::7] = 0
    first[::14] = 0
    second[::14] = 0
    return [x.to(dtype) for x in (parameter, gradient, first, second)]


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("steps", [1, 7, 30_000])
def test_the_kernel_stays_within_its_bounds(count: int, steps: int) -> None:
    by = AdamStep(rate=1e-2, beta1=0.9, beta2=0.99, eps=1e-12, taken=steps)
    parameter, gradient, first, second = drawn(count)
    size = by.beta1 * first.double().abs() + (1 - by.beta1) * gradient.double().abs()
    before = parameter.double()
    wide = [x.double() for x in (parameter, gradient, first, second)]
    adam.step_reference(wide[0], wide[1], Moments(*wide[2:]), by)
    assert adam.usable(parameter, gradient, eps=by.eps)
    adam.step(parameter, gradient, Moments(first, second), by)
    assert not gradient.any() and not wide[1].any()
    assert ((first.double() - wide[2]).abs() <= 3 * U * size).all()
    assert ((second.double() - wide[3]).abs() <= 4 * U * wide[3]).all()
    root = (wide[3] / (1 - by.beta2**steps)).sqrt() + by.eps
    step = by.rate / (1 - by.beta1**steps) * size / root
    assert (
        (parameter.double() - wide[0]).abs()
        <= 2 * U * torch.maximum(before.abs(), wide[0].abs()) + 16 * U * step
    ).all()
    assert torch.equal(parameter[::14], before[::14].float()), "what was never seen stays"


def test_the_plain_form_is_torchs_adam() -> None:
    parameter, gradient, _, _ = drawn(64, torch.float64)
    theirs = nn.Parameter(parameter.clone())
    optimizer = torch.optim.Adam([theirs], lr=1e-2, betas=(0.9, 0.99), eps=1e-12)
    moments = Moments(torch.zeros_like(parameter), torch.zeros_like(parameter))
    for count in range(1, 6):
        given = gradient.roll(count)
        theirs.grad = given.clone()
        optimizer.step()
        adam.step_reference(parameter, given, moments, AdamStep(1e-2, 0.9, 0.99, 1e-12, count))
    assert torch.allclose(parameter, theirs.detach(), rtol=1e-12, atol=0)


@pytest.mark.parametrize("large", [2**19, 2**19 + 5])
def test_the_norm_of_gradients(large: int) -> None:
    parameters = [nn.Parameter(torch.zeros(size)) for size in (5, large, 3)]
    for seed, parameter in enumerate(parameters[:2]):
        parameter.grad = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(seed))
    exact = math.sqrt(sum(float(p.grad.double().square().sum()) for p in parameters if p.grad is not None))
    # Squares are added in pieces of 1024 by 8 lanes at least: 128 + 4 roundings, of which a root keeps half.
    assert abs(float(adam.gradient_norm(parameters)) - exact) <= 68 * U * exact
    # Torch adds as many as it likes.
    assert abs(float(backend.plain()(adam.gradient_norm)(parameters)) - exact) <= 1e-4 * exact
    for bad in (math.nan, math.inf, -math.inf, 3e19):
        assert parameters[1].grad is not None
        parameters[1].grad[-1] = bad
        assert not adam.gradient_norm(parameters) < 1.8e19
