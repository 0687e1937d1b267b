"""Rendered views, plain and restyled, and views that are cached for any style."""

from dataclasses import replace

import pytest
import torch
from tiny_world import World
from two_sided import region_adain

from fprf.evaluation.metrics import psnr
from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    StylizerConfig,
)
from fprf.rendering.cameras import pixel_grid
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.restyle import apply_style
from fprf.style.scene_style import own_style
from fprf.training.loading import Trained, load_style
from fprf.training.views import view_chunks

STYLIZERS = (AdainConfig(), LocalAdainConfig(), region_adain(), RegionOtConfig())


def rendering(world: World, **fields: object) -> Trained:
    """The run with other fields of its render config."""
    trained = world.load()
    return replace(trained, config=replace(trained.config, render=replace(trained.config.render, **fields)))  # type: ignore[arg-type]


def test_a_view_does_not_depend_on_the_chunk(world: World) -> None:
    views = [rendering(world, chunk=chunk).render(world.load().cameras, 1) for chunk in (8192, 100, 7)]
    for other in views[1:]:
        assert torch.allclose(views[0].rgb, other.rgb, atol=1e-5)
        assert torch.allclose(views[0].depth, other.depth, rtol=1e-4)


@pytest.mark.parametrize("stylizer", [AdainConfig(), region_adain(), RegionOtConfig()], ids=lambda s: type(s).__name__)
def test_the_scenes_own_style_returns_the_render(world: World, stylizer: StylizerConfig) -> None:
    """Identity: 40 dB is promised; on this model 99 dB (differences of one rounding) were measured for all three."""
    trained = world.load()
    scene, _ = load_style(trained.run)
    own = trained.restyled(Restyle(stylizer.build(dictionary=own_style(scene), scene=scene)))
    for v in trained.known.split("all"):
        assert psnr(trained.render(trained.cameras, v).rgb, own.render(trained.cameras, v).rgb) >= 40


@pytest.mark.parametrize(
    ("stylizer", "strength", "chunk"),
    [*((each, 0.6, 100) for each in STYLIZERS), (RegionOtConfig(), 0.0, 8192), (RegionOtConfig(), 1.0, 8192)],
    ids=lambda given: type(given).__name__ if isinstance(given, StylizerConfig) else None,
)
def test_a_restyle_is_the_restyled_render(world: World, stylizer: StylizerConfig, strength: float, chunk: int) -> None:
    trained = rendering(world, chunk=chunk)
    cached = trained.cached(trained.cameras, 2)
    look = apply_style(
        trained, StyleFile(StyleConfig(references=world.references, stylizer=stylizer, strength=strength, clusters=3))
    ).restyle
    for style in (None, look, None):
        found, wanted = cached.restyled(style), trained.restyled(style).render(trained.cameras, 2)
        torch.testing.assert_close(found, wanted, atol=0, rtol=0)
        assert strength > 0 or torch.equal(found.rgb, cached.restyled().rgb), "strength 0 is the plain render"


@pytest.mark.parametrize("budget", [0.0, 0.2])
def test_budget_and_background_hold(world: World, budget: float) -> None:
    trained = rendering(world, budget=budget)
    facts = replace(trained.known.facts, background=(1.0, 0.0, 0.5))
    trained = replace(trained, known=replace(trained.known, facts=facts))
    cached = trained.cached(trained.cameras, 1)
    assert torch.equal(cached.restyled().rgb, trained.render(trained.cameras, 1).rgb)
    assert sum(part.rays for part in cached.chunks) == 32 * 24
    per_sample = 4 * (1 + 48 + trained.known.facts.dim) + 8
    kept = sum(len(part.kept.ray) for part in cached.chunks)
    assert kept * per_sample <= sum(part.bytes for part in cached.chunks) <= kept * per_sample + 16 * 32 * 24 + 8


def test_chunk_by_chunk_nothing_is_computed_ahead_and_means_are_those_of_match_maps(world: World) -> None:
    trained = rendering(world, chunk=100)
    known = trained.known
    stylizer = apply_style(
        trained, StyleFile(StyleConfig(references=world.references, stylizer=RegionOtConfig(), clusters=3))
    ).restyle.stylizer
    parts = view_chunks(trained.model, known.facts, known.cameras, 2, trained.config.render)
    first = next(parts)
    assert first.rays == 100 and first.semantic is not None
    wanted, _ = trained.paint(known.cameras, 2, pixel_grid(known.cameras, 2)[:100], lambda y, _: stylizer.match(y))
    assert torch.allclose(first.mean(stylizer.match(first.semantic)), wanted, atol=1e-6)
    assert 100 + sum(part.rays for part in parts) == 32 * 24
