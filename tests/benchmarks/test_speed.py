"""`bench speed`: what is compared is the same, what is counted is there, rounds and goals."""

from dataclasses import replace

import torch
from tiny_world import World

from benchmarks.speed import plain_planes
from benchmarks.subject import (
    difference,
    exact,
    plainly,
    view_rays,
)
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
