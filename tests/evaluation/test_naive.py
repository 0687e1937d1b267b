import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.evaluation.speed import grid_sample_lookup
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
