"""A folded style is the style: shares and pictures as they were within rounding, and nothing is folded that may not be."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.cli import main as cli
from fprf.ops import backend
from fprf.plugins.stylizers.config import LocalAdainConfig, RegionAdainConfig, RegionOtConfig, StylizerConfig
from fprf.training.folding import folded
from fprf.training.loading import Trained
from fprf.training.restyle import Styled, restyle
from fprf.training.views import match_view, render_view

DOT = LocalAdainConfig(similarity="dot")


def style(world: World, config: StylizerConfig = DOT, clusters: int = 4) -> tuple[Trained, Styled]:
    trained = world.load()
    return trained, restyle(trained, world.references[:1], config, clusters=clusters)


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("strength", [0.4, 1.0])
def test_pictures_and_shares_are_those_of_the_style(world: World, strength: float, plain: bool) -> None:
    trained, styled = style(world)
    styled = styled._replace(restyle=replace(styled.restyle, strength=strength))
    found = folded(trained.model, styled, DOT)
    assert found is not None
    known, render = trained.known, trained.config.render
    points = torch.empty(500, 3).uniform_(-1, 1, generator=torch.Generator().manual_seed(0))

    def drawn() -> tuple[torch.Tensor, ...]:
        with torch.no_grad():
            assert trained.model.semantic is not None and found.model.semantic is not None
            codes = len(styled.dictionary.keys)
            assert found.model.semantic(points).shape == (500, codes) and codes < known.facts.dim
            return (
                styled.restyle.stylizer.match(trained.model.semantic(points)),
                found.look.stylizer.match(found.model.semantic(points)),
                render_view(trained.model, known.facts, known.cameras, 2, render, styled.restyle).rgb,
                render_view(found.model, known.facts, known.cameras, 2, render, found.look).rgb,
                match_view(trained.model, known.cameras, 2, render, styled.restyle.stylizer),
                match_view(found.model, known.cameras, 2, render, found.look.stylizer),
            )

    if plain:
        with backend.plain():
            results = drawn()
    else:
        results = drawn()
    assert results[0].std() > 1e-3, "codes differ"
    for wanted, got in zip(results[::2], results[1::2], strict=True):
        assert (wanted - got).abs().max() <= 1e-5 * wanted.abs().max()


@pytest.mark.parametrize("config", [LocalAdainConfig(), RegionOtConfig(similarity="dot"), RegionAdainConfig()])
def test_cosines_and_regions_are_not_folded(world: World, config: StylizerConfig) -> None:
    trained, styled = style(world, config)
    assert folded(trained.model, styled, config) is None


def test_what_would_save_nothing_is_not_folded(world: World) -> None:
    trained, styled = style(world, clusters=1)
    assert folded(trained.model, styled, DOT) is None, "one code reads no semantics"
    dim = trained.known.facts.dim
    many = styled.dictionary._replace(keys=torch.randn(dim, dim))
    assert trained.model.semantic is not None and trained.model.semantic.projected(many.keys) is None


def test_looks_that_read_more_are_not_folded(world: World) -> None:
    trained, styled = style(world)
    mixed = styled._replace(restyle=styled.restyle.mixed(styled.restyle, 0.5))
    assert folded(trained.model, mixed, DOT) is None
    coloured = restyle(trained, world.references[:1], replace(DOT, colours=1.0), clusters=4)
    assert coloured.restyle.colours is not None and folded(trained.model, coloured, DOT) is None
    choosy = styled._replace(orders=styled.orders._replace(allowed=torch.zeros_like(styled.orders.allowed)))
    assert folded(trained.model, choosy, DOT) is None


def test_the_verb_draws_the_folded_style(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fprf.training import folding

    given = []

    def watched(*args: object) -> object:
        given.append(folded(*args))  # type: ignore[arg-type]
        return given[-1]

    monkeypatch.setattr(folding, "folded", watched)
    flags = ["--stylizer", "local-adain", "--stylizer.similarity", "dot", "--clusters", "4", "--views", "0002"]
    args = ["stylize", str(world.run), "--references", str(world.references[0]), "--output", str(tmp_path), *flags]
    assert cli.main([*args, "--device", "cpu"]) == 0
    assert len(given) == 1 and given[0] is not None
