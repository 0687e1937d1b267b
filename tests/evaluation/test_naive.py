from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_world import World

from fprf.evaluation.naive import grid_sample_lookup, plain_planes, replaced, without_skipping
from fprf.fields.planes import Planes
from fprf.ops import triplane


def made(resolutions: tuple[int, ...], channels: int, seed: int, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(50, 3, generator=generator, dtype=dtype) * 2.4 - 1.2
    return points, torch.randn(triplane.rows(resolutions), channels, generator=generator, dtype=dtype)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(2, 9), min_size=1, max_size=3), st.integers(1, 9), st.integers(0, 99))
def test_grid_sample_is_the_same_lookup(resolutions: list[int], channels: int, seed: int) -> None:
    """In float64 both round by 1e-16; what is left is a step over a node's edge, which both take continuously."""
    points, table = made(tuple(resolutions), channels, seed, torch.float64)
    leaves = [table.clone().requires_grad_() for _ in range(2)]
    forms = (grid_sample_lookup, triplane.lookup_reference)
    values = [form(points, leaf, tuple(resolutions)) for form, leaf in zip(forms, leaves, strict=True)]
    assert torch.allclose(*values, rtol=1e-10, atol=1e-10)
    gradients = [torch.autograd.grad(v.square().sum(), leaf)[0] for v, leaf in zip(values, leaves, strict=True)]
    assert torch.allclose(*gradients, rtol=1e-9, atol=1e-9)


def test_a_method_is_replaced_for_a_while_in_one_module_alone() -> None:
    first, second = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    x = torch.ones(1, 2)
    before = first(x)
    with replaced(first, "forward", lambda ours: lambda x: ours(x) + 1):
        assert torch.equal(first(x), before + 1) and second.forward(x).shape == (1, 2)
    assert torch.equal(first(x), before) and "forward" not in vars(first)


def test_it_is_put_back_after_an_error() -> None:
    module = torch.nn.Identity()
    with pytest.raises(ZeroDivisionError), replaced(module, "forward", lambda ours: lambda x: 1 / 0):
        module(torch.ones(1))
    assert torch.equal(module(torch.ones(1)), torch.ones(1))


def test_plain_planes_use_no_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    planes = Planes((4, 8), 8, generator=torch.Generator().manual_seed(0))
    points = torch.rand(20, 3) * 2 - 1
    with torch.no_grad():
        ours, varied = planes(points), planes.variation()

        def refused(*args: object, **kwargs: object) -> None:
            raise AssertionError("a kernel ran")

        for name in ("lookup", "variation"):
            monkeypatch.setattr(triplane, name, refused)
        with plain_planes(torch.nn.ModuleList([planes])):
            assert torch.allclose(planes(points), ours, atol=1e-5) and torch.allclose(planes.variation(), varied)
        with pytest.raises(AssertionError, match="a kernel ran"):
            planes(points)


def test_nothing_is_skipped(world: World) -> None:
    plain = without_skipping(world.config)
    assert plain.render.budget == plain.render.train_budget == 0 and plain.loss.penalty_every == 1
    assert plain.datamanager == replace(world.config.datamanager, semantic_share=1.0)
    assert plain.semantic.samples >= 10**6
    assert (plain.content, plain.sampler, plain.optimizer) == (
        world.config.content,
        world.config.sampler,
        world.config.optimizer,
    )
