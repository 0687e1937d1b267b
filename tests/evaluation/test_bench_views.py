from dataclasses import replace

import pytest
import torch
from tiny_world import World

from fprf.evaluation.speed import plain_planes
from fprf.evaluation.subject import count, difference, exact, plainly, view_rays
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionOtConfig
from fprf.rendering.renderer import march
from fprf.training.restyle import restyle
from fprf.training.views import render_view


def test_exact_is_double_and_every_way_comes_near_it(world: World) -> None:
    trained = world.load()
    known, model = trained.known, trained.model
    rays = view_rays(model, known.cameras, 1)
    for stylizer in (None, RegionOtConfig(), LocalAdainConfig()):
        look = None if stylizer is None else restyle(trained, world.references, stylizer).restyle
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


def test_counts_are_those_of_the_march(world: World) -> None:
    trained = world.load()
    rays = view_rays(trained.model, trained.known.cameras, 0)
    with torch.inference_mode():
        kept = march(rays, trained.model.parts, budget=0.3).kept
    found = count(trained.model.parts, rays, 0.3)
    assert (found.rays, found.samples, found.kept) == (768, 768 * 8, len(kept.ray))
    assert found.empty == 768 - len(set(kept.ray.tolist()))
    assert found.shares["kept_samples_per_ray"] == pytest.approx(len(kept.ray) / 768)


def test_rays_that_see_nothing_are_counted(world: World) -> None:
    trained = world.load()
    with torch.no_grad():
        trained.model.get_parameter("field.to_density.weight").fill_(-1e6)
    found = count(trained.model.parts, view_rays(trained.model, trained.known.cameras, 0), 1 / 512)
    assert found.kept == 0 and found.shares["empty_rays_share"] == 1
