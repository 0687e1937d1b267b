"""The colour head of a scene: nothing at first, trained with the scene, and gone where a style changes the colour."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_world import World, rays_of, trained_for

from fprf.config import TrainConfig
from fprf.plugins.decoders.config import MlpDecoderConfig, ResidualDecoderConfig
from fprf.plugins.decoders.decoders import MlpDecoder, ResidualDecoder
from fprf.plugins.encoders.config import BundledContentConfig
from fprf.plugins.stylizers.config import AdainConfig, RegionAdainConfig, RegionOtConfig, StylizerConfig
from fprf.rendering.renderer import Parts, render_rays
from fprf.style.look import Restyle
from fprf.style.scene import own_style
from fprf.testing import check_decoder
from fprf.training.loading import Trained, load_run
from fprf.training.losses import terms, total
from fprf.training.model import build_model
from fprf.training.style_pass import measure_style
from fprf.training.views import render_view
from fprf.types import Batch, Rendered, Sampled, Want

C = 6


def decoder_of(fade: float = 0.5, trained: bool = True) -> ResidualDecoder:
    draw = torch.Generator().manual_seed(3)
    frozen = MlpDecoder(C, 9).requires_grad_(False)
    made = ResidualDecoder(frozen, hidden=7, fade=fade, generator=draw)
    if trained:
        with torch.no_grad():
            made.head.second.normal_(std=2.5, generator=draw)
    return made


def residual_config(world: World) -> TrainConfig:
    return replace(world.config, content=replace(world.config.content, decoder=ResidualDecoderConfig()))


def exaggerated(trained: Trained) -> Trained:
    """A head that shows: a few steps hardly move it."""
    decoder = trained.model.decoder
    assert isinstance(decoder, ResidualDecoder)
    with torch.no_grad():
        decoder.head.second.normal_(std=2.0, generator=torch.Generator().manual_seed(0))
    return trained


@pytest.fixture(scope="module")
def run(_world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    config, folder = residual_config(_world), tmp_path_factory.mktemp("residual") / "run"
    made = trained_for(_world, folder, config)
    made.save_config(replace(config, output=None), "fprf-lite")
    made.save_known(_world.prepared.scene, _world.town, _world.prepared.facts)
    return folder


@pytest.fixture
def trained(world: World, run: Path) -> Trained:
    return load_run(run, "cpu")


def test_it_keeps_the_contract() -> None:
    encoder = BundledContentConfig().build()
    check_decoder(ResidualDecoderConfig(), encoder=encoder.identity, channels=encoder.channels)
    check_decoder(MlpDecoderConfig(), encoder=encoder.identity, channels=encoder.channels)


def test_a_new_head_changes_nothing_and_is_all_that_learns() -> None:
    made, content = decoder_of(trained=False), torch.randn(50, C)
    assert torch.equal(made(content), made.frozen(content))
    assert {name.partition(".")[0] for name, p in made.named_parameters() if p.requires_grad} == {"head"}
    made(content).square().sum().backward()  # type: ignore[no-untyped-call]
    assert made.head.second.grad is not None and float(made.head.second.grad.abs().sum()) > 0


def test_a_head_learns_at_the_rate_of_the_planes_without_saturating() -> None:
    """Wide, at once and from random colours, as a field gives them at first: plain weights ran off and died there."""
    torch.manual_seed(0)
    made = ResidualDecoder(
        MlpDecoder(32, 128).requires_grad_(False), hidden=32, fade=0.5, generator=torch.Generator().manual_seed(0)
    )
    optimizer = torch.optim.Adam([p for p in made.parameters() if p.requires_grad], 1e-2, betas=(0.9, 0.99), eps=1e-12)
    losses, moves = [], []
    for _ in range(80):
        content = torch.randn(256, 32)
        target = torch.sigmoid(3 * content[:, :3])
        before = made.head(made.frozen.hidden(content)).detach()
        loss = (made(content) - target).square().mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        losses.append(float(loss.detach()))
        moves.append(float((made.head(made.frozen.hidden(content)).detach() - before).abs().max()))
    assert max(moves) < 0.3
    assert max(losses) < 1.1 * losses[0]
    assert losses[-1] < 0.7 * losses[0]


@settings(max_examples=25, deadline=None)
@given(strength=st.floats(0, 1), fade=st.floats(0.05, 5), shift=st.floats(0, 3), seed=st.integers(0, 99))
def test_the_formula_in_float64(strength: float, fade: float, shift: float, seed: int) -> None:
    made = decoder_of(fade)
    draw = torch.Generator().manual_seed(seed)
    content = torch.randn(8, C, generator=draw)
    styled = content + shift * torch.randn(8, C, generator=draw)
    found = made.restyled(content, styled, strength)
    exact = decoder_of(fade).double()
    exact.load_state_dict(made.state_dict())

    def logit(features: torch.Tensor) -> torch.Tensor:
        return exact.frozen.second(torch.relu(exact.frozen.first(features.double())))

    change = (logit(styled) - logit(content)).square().mean(1, keepdim=True)
    share = (1 - strength) + strength * torch.exp(-change / fade**2)
    inner = torch.relu(torch.relu(exact.frozen.first(content.double())) @ exact.head.first.T / 3 + exact.head.first_bias)
    residual = inner @ exact.head.second.T / 7**0.5 + exact.head.second_bias
    # Rounding of a change grows with 1 / fade^2 in the exponent.
    expected = torch.sigmoid(logit(styled) + share * residual)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=2e-5 / min(fade, 1.0))


@pytest.mark.parametrize("stylizer", [AdainConfig(), RegionAdainConfig(), RegionOtConfig()])
def test_the_scenes_own_style_gives_the_scene_back(stylizer: StylizerConfig, world: World, trained: Trained) -> None:
    scene, known, model = world.prepared.scene, trained.known, exaggerated(trained).model
    style = measure_style(trained.config, model, scene.cameras, scene.train)
    built = stylizer.build(dictionary=own_style(style), scene=style)

    def view(restyle: Restyle | None) -> torch.Tensor:
        return render_view(model, known.facts, known.cameras, 0, trained.config.render, restyle).rgb

    plain = view(None)
    assert float((plain - view_without_head(trained)).abs().max()) > 0.02
    assert torch.equal(view(Restyle(built, 0.0)), plain)
    for strength in (0.4, 1.0):
        error = (view(Restyle(built, strength)) - plain).double().square().mean()
        assert -10 * math.log10(max(float(error), 1e-12)) >= 40


def view_without_head(trained: Trained) -> torch.Tensor:
    model, known = trained.model, trained.known
    whole, model.decoder = model.decoder, model.decoder.frozen  # type: ignore[assignment]
    found = render_view(model, known.facts, known.cameras, 0, trained.config.render).rgb
    model.decoder = whole
    return found


@pytest.mark.parametrize("background", [None, torch.tensor([0.2, 0.5, 0.9])])
def test_training_sees_both_colours_and_rendering_one(background: torch.Tensor | None, world: World, trained: Trained) -> None:
    parts = exaggerated(trained).model.parts
    rays = rays_of(world, trained, world.prepared.manager.batch(0))

    def render(parts: Parts, step: int | None) -> Rendered:
        return render_rays(rays, parts, want=Want.COLOUR, budget=0.0, background=background, step=step)

    both, shown = render(parts, 0), render(parts, None)
    assert shown.frozen_rgb is None
    assert both.rgb is not None and both.frozen_rgb is not None
    decoder = parts.decoder
    assert isinstance(decoder, ResidualDecoder)
    alone = render(parts._replace(decoder=decoder.frozen), 0)
    assert alone.rgb is not None and alone.frozen_rgb is None
    assert torch.equal(both.frozen_rgb, alone.rgb)
    assert float((both.rgb - both.frozen_rgb).abs().max()) > 0.02


def rendered_of(rgb: float, unaided: float | None) -> Rendered:
    """One ray, whose colours are given."""
    edges, one = torch.tensor([[0.0, 1.0]]), torch.ones(1)
    frozen = None if unaided is None else torch.full((1, 3), unaided)
    return Rendered(one, one, rgb=torch.full((1, 3), rgb), weights=one[None], sampled=Sampled(edges, edges), frozen_rgb=frozen)


@pytest.mark.parametrize("unaided", [None, 0.9])
def test_the_frozen_part_is_taught_as_well(unaided: float | None, world: World) -> None:
    config = replace(world.config.loss, rgb=0.5, distortion=0.0, interlevel=0.0, variation=0.0, proposal_variation=0.0)
    batch = Batch(torch.zeros(1, dtype=torch.int64), torch.zeros(1, 2), torch.full((1, 3), 0.4))
    facts = world.prepared.facts
    found = terms(config, facts, rendered_of(0.5, unaided), batch, build_model(world.config, facts), step=0)
    assert set(found) == {"rgb"} | ({"unaided"} if unaided else set())
    mean = (0.1**2 + 0.5**2) / 2 if unaided else 0.1**2
    assert float(total(config, found)) == pytest.approx(0.5 * mean, rel=1e-5)
