from dataclasses import replace

import pytest
import torch
from shelves import cards_of
from tiny_world import World

from fprf.errors import UsageError
from fprf.style.config import StyleConfig
from fprf.style.dictionary import build_dictionary
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.training.regions import membership_view
from fprf.training.restyle import apply_style
from fprf.training.views import render_view
from fprf.viewer.looks import Look, ordered, style_of
from fprf.viewer.restyler import Studio, joined, names_of


def seen(studio: Studio, restyle: Restyle | None) -> torch.Tensor:
    trained = studio.trained
    return render_view(trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle).rgb


def test_a_look_is_the_style_that_the_command_line_makes(world: World) -> None:
    studio = Studio(world.load())
    a, b = cards_of(studio, world)
    look = ordered(Look(mix=((a, 1.0), (b, 0.5)), strength=0.8, clusters=3, luminance=0.2), 1, "pin", b)
    wanted = apply_style(studio.trained, StyleFile(style_of(look)))
    assert torch.allclose(seen(studio, studio.restyle(look)), seen(studio, wanted.restyle), atol=2e-5)


def test_no_photograph_and_no_strength_are_the_scene_as_it_is(world: World) -> None:
    studio = Studio(world.load())
    a, _ = cards_of(studio, world)
    assert studio.styled(Look()) is None and studio.styled(Look(mix=((a, 1.0),), strength=0.0)) is None


def test_between_two_looks(world: World) -> None:
    studio = Studio(world.load())
    a, b = cards_of(studio, world)
    one, two = Look(mix=((a, 1.0),), clusters=3), Look(mix=((b, 1.0),), clusters=3)
    half = replace(one, towards=two, at=0.5)
    ends = [studio.restyle(each) for each in (one, two)]
    assert ends[0] is not None and ends[1] is not None
    assert torch.equal(seen(studio, studio.restyle(half)), seen(studio, ends[0].mixed(ends[1], 0.5)))
    assert names_of(half) == ("dusk.png", "snow.png") and names_of(one) == ("dusk.png",)
    from_plain = replace(Look(), towards=two, at=0.5)
    assert torch.allclose(seen(studio, studio.restyle(from_plain)), seen(studio, ends[1].faded.mixed(ends[1], 0.5)), atol=1e-5)


def test_joining_is_building_at_once(world: World) -> None:
    studio = Studio(world.load())
    cards = cards_of(studio, world)
    parts = [build_dictionary([card.reference], clusters=3) for card in cards]
    found = joined(parts, [card.name for card in cards], [1.0, 2.0])
    references = [card.reference._replace(weight=weight) for card, weight in zip(cards, (1.0, 2.0), strict=True)]
    wanted = build_dictionary(references, clusters=3)
    for name in found.names:
        mine, its = found.reference == found.names.index(name), wanted.reference == wanted.names.index(name)
        for field in ("keys", "mean", "covariance", "share", "weight", "colour_mean", "colour_covariance"):
            assert torch.equal(getattr(found, field)[mine], getattr(wanted, field)[its])


def test_styles_are_kept_and_bounded(world: World) -> None:
    studio = Studio(world.load())
    a, _ = cards_of(studio, world)
    first = Look(mix=((a, 1.0),), clusters=2)
    styled = studio.styled(first)
    assert studio.styled(replace(first, towards=None)) is styled
    for step in range(30):
        studio.styled(replace(first, strength=0.01 * (step + 1)))
    assert len(studio._styles) <= 24 and len(studio._dictionaries) == 1
    studio.keep([a])
    assert studio._styles and studio._dictionaries
    studio.keep([])
    assert not studio._styles and not studio._dictionaries


def test_a_click_finds_the_region_that_is_there(world: World) -> None:
    studio = Studio(world.load())
    trained = studio.trained
    _, *_ = cards_of(studio, world)
    cameras = trained.known.cameras.select(torch.tensor([2]))
    from fprf.training.regions import Regions

    share, _ = membership_view(Regions(trained, studio.encoders.scene, studio.encoders.basis), 2, 1000)
    for x, y in ((3, 4), (20, 18), (31, 23)):
        assert studio.region_at(cameras, (x + 0.5, y + 0.5)) == int(share[y, x].argmax())
    with pytest.raises(UsageError, match="outside"):
        studio.region_at(cameras, (32.0, 1.0))


def test_what_there_is_to_say_of_a_region(world: World) -> None:
    studio = Studio(world.load())
    a, b = cards_of(studio, world)
    assert studio.picked(Look(), 0).taken == ()
    look = Look(mix=((a, 1.0), (b, 1.0)), clusters=3)
    picked = studio.picked(look, 1)
    assert {name for name, _ in picked.taken} == {"dusk.png", "snow.png"}
    assert sum(share for _, share in picked.taken) == pytest.approx(1.0, abs=1e-4) and 0 < picked.share < 1
    # A soft membership leaves a little to the neighbours of a pinned region.
    assert dict(studio.picked(ordered(look, 1, "pin", b), 1).taken)["snow.png"] > 0.5
    kept = studio.picked(ordered(look, 1, "keep"), 1)
    assert sum(share for _, share in kept.taken) < sum(share for _, share in picked.taken)


def test_styles_ask_for_at_least_one_reference() -> None:
    assert StyleConfig().references == ()
