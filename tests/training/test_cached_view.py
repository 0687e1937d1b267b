"""A cached view in any style is the view rendered in that style, bit for bit, and knows nothing of a style before."""

from dataclasses import replace

import pytest
import torch
from tiny_world import World

from fprf.plugins.stylizers.config import (
    AdainConfig,
    IdentityConfig,
    LocalAdainConfig,
    RegionAdainConfig,
    RegionOtConfig,
    StylizerConfig,
)
from fprf.rendering.cameras import pixel_grid
from fprf.training.restyle import restyle
from fprf.training.views import cache_view, render_view, view_parts

STYLIZERS = (IdentityConfig(), AdainConfig(), LocalAdainConfig(), RegionAdainConfig(), RegionOtConfig())


@pytest.mark.parametrize(
    ("stylizer", "strength", "chunk"),
    [*((each, 0.6, 100) for each in STYLIZERS), (RegionOtConfig(), 0.0, 8192), (RegionOtConfig(), 1.0, 8192)],
    ids=lambda given: type(given).__name__ if isinstance(given, StylizerConfig) else None,
)
def test_a_restyle_is_the_restyled_render(world: World, stylizer: StylizerConfig, strength: float, chunk: int) -> None:
    trained = world.load()
    config, known = replace(trained.config.render, chunk=chunk), trained.known
    cached = cache_view(trained.model, known.facts, known.cameras, 2, config)
    look = restyle(trained, world.references, stylizer, strength=strength, clusters=3).restyle
    for style in (None, look, None):
        found, wanted = cached.restyled(style), render_view(trained.model, known.facts, known.cameras, 2, config, style)
        assert torch.equal(found.rgb, wanted.rgb)
        assert torch.equal(found.depth, wanted.depth) and torch.equal(found.opacity, wanted.opacity)
        assert found.kept == wanted.kept


def test_styles_that_fade_into_another(world: World) -> None:
    trained = world.load()
    known, render = trained.known, trained.config.render
    looks = [restyle(trained, [path], RegionOtConfig()).restyle for path in world.references]
    mixed = replace(looks[0].mixed(looks[1], 0.3), luminance=0.5)
    cached = cache_view(trained.model, known.facts, known.cameras, 0, render)
    assert torch.equal(cached.restyled(mixed).rgb, render_view(trained.model, known.facts, known.cameras, 0, render, mixed).rgb)


@pytest.mark.parametrize("budget", [0.0, 0.2])
def test_budget_and_background_hold(world: World, budget: float) -> None:
    trained = world.load()
    facts, render = replace(trained.known.facts, background=(1.0, 0.0, 0.5)), replace(trained.config.render, budget=budget)
    cached = cache_view(trained.model, facts, trained.known.cameras, 1, render)
    assert torch.equal(cached.restyled().rgb, render_view(trained.model, facts, trained.known.cameras, 1, render).rgb)
    assert sum(part.rays for part in cached.parts) == 32 * 24
    per_sample = 4 * (1 + 48 + trained.known.facts.dim) + 8
    kept = sum(len(part.kept.ray) for part in cached.parts)
    assert kept * per_sample <= cached.bytes <= kept * per_sample + 16 * 32 * 24 + 8


def test_chunk_by_chunk_nothing_is_computed_ahead_and_means_are_those_of_match_maps(world: World) -> None:
    trained = world.load()
    known, config = trained.known, replace(trained.config.render, chunk=100)
    stylizer = restyle(trained, world.references, RegionOtConfig(), clusters=3).restyle.stylizer
    parts = view_parts(trained.model, known.facts, known.cameras, 2, config)
    first = next(parts)
    assert first.rays == 100 and first.semantic is not None
    wanted, _ = trained.paint(known.cameras, 2, pixel_grid(known.cameras, 2)[:100], stylizer.match)
    assert torch.allclose(first.mean(stylizer.match(first.semantic)), wanted, atol=1e-6)
    assert 100 + sum(part.rays for part in parts) == 32 * 24
