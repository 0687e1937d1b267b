"""Gradients along rays, compiled, against autograd in fp64: of weights, of what is kept, of composites."""

import math

import pytest
import torch

from fprf.ops import march
from fprf.rendering.stepfun import transmittance_weights

U = 2.0**-24
"""Unit round-off of float32."""


@pytest.mark.parametrize("samples", [1, 10, 33])
@pytest.mark.parametrize("fair", [False, True])
@pytest.mark.parametrize("thickness", [1e-6, 1.0, 1e4])
def test_gradients_of_weights_and_of_what_passes(samples: int, fair: bool, thickness: float) -> None:
    """Within 1e-5 of the largest incoming gradient times the step, as `stepfun`'s own."""
    draw = torch.Generator().manual_seed(samples)
    density = (torch.rand(21, samples, generator=draw) * thickness).requires_grad_(True)
    t = torch.nn.functional.pad(torch.rand(21, samples, generator=draw).cumsum(-1), (1, 0))
    scale = torch.rand(21, samples, generator=draw) if fair else None
    g, h = torch.randn(21, samples, generator=draw), torch.randn(21, generator=draw)
    exact_density = density.detach().double().requires_grad_(True)
    exact = transmittance_weights(exact_density, t.double())
    through = torch.exp(-(exact_density * t.double().diff(dim=-1)).sum(-1))
    for parts in ((True, True), (True, False), (False, True)):
        found = march.weigh(density, t, 0.01, fair=scale)
        assert not found.depth.requires_grad and not found.opacity.requires_grad
        ours = (found.weights * g).sum() * parts[0] + (found.through * h).sum() * parts[1]
        theirs = (exact * g).sum() * parts[0] + (through * h).sum() * parts[1]
        (got,) = torch.autograd.grad(ours, density)
        (want,) = torch.autograd.grad(theirs, exact_density, retain_graph=True)
        want = want if scale is None else want * scale
        bound = 1e-5 * t.diff(dim=-1) * (g.abs().amax(-1) + h.abs())[:, None]
        assert ((got - want).abs() <= bound).all()


@pytest.mark.parametrize("rays", [1, 3])
def test_only_one_of_both_may_be_asked_for(rays: int) -> None:
    density = torch.rand(rays, 4).requires_grad_(True)
    t = torch.arange(5.0).repeat(rays, 1)
    found = march.weigh(density, t, 0.0)
    (alone,) = torch.autograd.grad(found.through.sum(), density)
    assert torch.allclose(alone, -found.through[:, None].expand(rays, 4))
    (alone,) = torch.autograd.grad(march.weigh(density, t, 0.0).weights.sum(), density)
    assert torch.allclose(alone, found.through[:, None].expand(rays, 4)), "what does not pass is what is seen"


@pytest.mark.parametrize("latents", [3, 64])
def test_gradients_go_back_to_the_kept_samples(latents: int) -> None:
    draw = torch.Generator().manual_seed(0)
    density, t = torch.rand(29, 8, generator=draw).requires_grad_(True), torch.arange(9.0).repeat(29, 1)
    weighed = march.weigh(density, t, 0.1)
    point, latent = torch.rand(29, 8, 3, generator=draw), torch.rand(29 * 8, latents, generator=draw).requires_grad_(True)
    fair = torch.rand(29, 8, generator=draw)
    found = march.gather(weighed, point, latent, point[:, 0], fair)
    index = weighed.keep.view(-1).nonzero()[:, 0]
    assert found.fair is not None and torch.equal(found.fair, fair.view(-1)[index])
    assert found.weight.requires_grad and found.latent.requires_grad
    assert not any(x.requires_grad for x in (found.ray, found.point, found.view, found.fair))
    g, h = torch.randn(len(index), generator=draw), torch.randn(len(index), latents, generator=draw)
    loss = (found.weight * g).sum() + (found.latent * h).sum()
    got = torch.autograd.grad(loss, (weighed.weights, latent), retain_graph=True)
    assert torch.equal(got[0].view(-1), torch.zeros(29 * 8).index_copy(0, index, g))
    assert torch.equal(got[1], torch.zeros(29 * 8, latents).index_copy(0, index, h))
    (alone,) = torch.autograd.grad((found.weight * g).sum(), weighed.weights, retain_graph=True)
    assert torch.equal(alone, got[0])


def test_a_single_sample_gets_its_gradient() -> None:
    density = torch.ones(1, 1, requires_grad=True)
    weighed = march.weigh(density, torch.tensor([[0.0, 1.0]]), 0.0)
    found = march.gather(weighed, torch.zeros(1, 1, 3), torch.zeros(1, 3), torch.zeros(1, 3))
    (got,) = torch.autograd.grad(5 * found.weight.sum(), density)
    assert got.item() == pytest.approx(5 * math.exp(-1), rel=1e-6)


@pytest.mark.parametrize("width", [1, 3, 48])
def test_composites_are_sums_over_each_ray(width: int) -> None:
    draw = torch.Generator().manual_seed(0)
    start = torch.tensor([0, 0, 5, 6, 6, 40, 41])
    ray = torch.repeat_interleave(torch.arange(6), start.diff())
    weight, values = torch.rand(41, generator=draw), torch.randn(41, width, generator=draw)
    inputs = [x.requires_grad_(True) for x in (weight, values)]
    doubles = [x.detach().double().requires_grad_(True) for x in inputs]
    exact = torch.zeros(6, width, dtype=torch.float64).index_add(0, ray, doubles[1] * doubles[0][:, None])
    found = march.composite(weight, values, start)
    assert ((found - exact).abs() <= 40 * U * 10).all() and torch.equal(found[[0, 3]], torch.zeros(2, width))
    g = torch.randn(6, width, generator=draw)
    for wanted in ([0, 1], [0], [1]):
        given = [x if k in wanted else x.detach() for k, x in enumerate(inputs)]
        got = torch.autograd.grad((march.composite(given[0], given[1], start) * g).sum(), [inputs[k] for k in wanted])
        want = torch.autograd.grad((exact * g).sum(), [doubles[k] for k in wanted], retain_graph=True)
        assert all(torch.allclose(a.double(), b, atol=width * 1e-6) for a, b in zip(got, want, strict=True))


def test_nothing_kept_is_no_colour() -> None:
    weight, values = torch.zeros(0, requires_grad=True), torch.zeros(0, 3)
    found = march.composite(weight, values, torch.zeros(4, dtype=torch.int64))
    assert torch.equal(found, torch.zeros(3, 3))
