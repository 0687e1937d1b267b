"""`bench speed`: what is compared is the same, what is counted is there, rounds and goals."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from benchmarks.report import ratio
from benchmarks.speed import grid_sample_lookup, plain_planes
from benchmarks.subject import (
    difference,
    exact,
    plainly,
    view_rays,
)
from fprf.ops import triplane
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionOtConfig
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.restyle import apply_style
from fprf.training.views import render_view


def test_exact_is_double_and_every_way_comes_near_it(world: World) -> None:
    trained = world.load()
    known, model = trained.known, trained.model
    rays = view_rays(model, known.cameras, 1)
    for stylizer in (None, RegionOtConfig(), LocalAdainConfig()):
        look = (
            None
            if stylizer is None
            else apply_style(trained, StyleFile(StyleConfig(references=world.references, stylizer=stylizer))).restyle
        )
        truth = exact(model, known.facts, rays, look)
        assert truth.dtype == torch.float64 and truth.shape == (24 * 32, 3)
        render = replace(trained.config.render, budget=0.0)
        ways = {
            "ours": render_view(model, known.facts, known.cameras, 1, render, look).rgb.view(-1, 3),
            "plain": plainly(model, known.facts, rays, render, look),
        }
        with plain_planes(model):
            ways["naive"] = plainly(model, known.facts, rays, render, look)
        for name, found in ways.items():
            assert difference(found, truth).largest < 1e-4, name
    assert all(p.dtype == torch.float32 for p in model.parameters()), "the run's own model stays as it is"


@given(st.lists(st.integers(2, 9), min_size=1, max_size=3), st.integers(1, 9), st.integers(0, 99))
def test_grid_sample_is_the_same_lookup(resolutions: list[int], channels: int, seed: int) -> None:
    """In float64 both round by 1e-16; what is left is a step over a node's edge, which both take continuously."""
    draw = torch.Generator().manual_seed(seed)
    points = torch.rand(50, 3, generator=draw, dtype=torch.float64) * 2.4 - 1.2
    table = torch.randn(triplane.rows(tuple(resolutions)), channels, generator=draw, dtype=torch.float64)
    leaves = [table.clone().requires_grad_() for _ in range(2)]
    forms = (grid_sample_lookup, triplane.lookup_reference)
    values = [form(points, leaf, tuple(resolutions)) for form, leaf in zip(forms, leaves, strict=True)]
    assert torch.allclose(*values, rtol=1e-10, atol=1e-10)
    gradients = [torch.autograd.grad(v.square().sum(), leaf)[0] for v, leaf in zip(values, leaves, strict=True)]
    assert torch.allclose(*gradients, rtol=1e-9, atol=1e-9)


@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=9), st.floats(0.1, 50))
def test_load_that_both_meet_in_a_round_cancels(loads: list[float], faster: float) -> None:
    found = ratio([faster * load for load in loads], loads)
    for value in found[:3]:
        assert value == pytest.approx(faster)
