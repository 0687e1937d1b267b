from dataclasses import replace

import pytest
import torch
from photographs import encoded
from tiny_world import World

from fprf.errors import UsageError
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.regions import membership_view
from fprf.style.restyle import apply_style
from fprf.style.scene import SceneStyle
from fprf.training.views import render_view
from fprf.viewer.restyler import Restyler, matching_regions
from fprf.viewer.state import Look, set_rule, style_config


def seen(restyler: Restyler, restyle: Restyle | None) -> torch.Tensor:
    trained = restyler.scene
    return render_view(trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle).rgb


def test_a_look_is_the_style_that_the_command_line_makes(world: World) -> None:
    restyler = Restyler(world.load())
    a, b = encoded(restyler, world)
    look = set_rule(Look(mix=((a, 1.0), (b, 0.5)), strength=0.8, clusters=3, luminance=0.2), 1, "pin", b)
    wanted = apply_style(restyler.scene, StyleFile(style_config(look)))
    assert torch.allclose(seen(restyler, restyler.restyle(look)), seen(restyler, wanted.restyle), atol=2e-5)


def test_between_two_looks(world: World) -> None:
    restyler = Restyler(world.load())
    a, b = encoded(restyler, world)
    one, two = Look(mix=((a, 1.0),), clusters=3), Look(mix=((b, 1.0),), clusters=3)
    half = replace(one, towards=two, at=0.5)
    ends = [restyler.restyle(each) for each in (one, two)]
    assert ends[0] is not None and ends[1] is not None
    assert torch.equal(seen(restyler, restyler.restyle(half)), seen(restyler, ends[0].mixed(ends[1], 0.5)))
    assert {name for name, _ in restyler.region_info(half, 0).taken} == {"dusk.png", "snow.png"}
    from_plain = replace(Look(), towards=two, at=0.5)
    assert torch.allclose(
        seen(restyler, restyler.restyle(from_plain)), seen(restyler, ends[1].faded.mixed(ends[1], 0.5)), atol=1e-5
    )


def test_styles_are_kept_and_bounded(world: World) -> None:
    restyler = Restyler(world.load())
    a, _ = encoded(restyler, world)
    first = Look(mix=((a, 1.0),), clusters=2)
    styled = restyler.styled(first)
    assert restyler.styled(replace(first, towards=None)) is styled
    for step in range(30):
        restyler.styled(replace(first, strength=0.01 * (step + 1)))
    assert len(restyler._styles) <= 24 and len(restyler._dictionaries) == 1
    restyler.retain([a])
    assert restyler._styles and restyler._dictionaries
    restyler.retain([])
    assert not restyler._styles and not restyler._dictionaries


def test_a_click_finds_the_region_that_is_there(world: World) -> None:
    restyler = Restyler(world.load())
    trained = restyler.scene
    _, *_ = encoded(restyler, world)
    cameras = trained.known.cameras.select(torch.tensor([2]))
    from fprf.style.regions import Regions

    share, _ = membership_view(Regions(trained, restyler.encoders.scene, restyler.encoders.basis), 2, 1000)
    for x, y in ((3, 4), (20, 18), (31, 23)):
        assert restyler.region_at(cameras, (x + 0.5, y + 0.5)) == int(share[y, x].argmax())
    with pytest.raises(UsageError, match="outside"):
        restyler.region_at(cameras, (32.0, 1.0))


def test_regions_are_known_again_whatever_their_order() -> None:
    generator = torch.Generator().manual_seed(0)
    keys = torch.randn(6, 8, generator=generator)
    middle = torch.randn(8, generator=generator)

    def style(keys: torch.Tensor) -> SceneStyle:
        k, c = len(keys), 3
        return SceneStyle(
            torch.zeros(c),
            torch.eye(c),
            keys,
            torch.zeros(k, c),
            torch.zeros(k, c, c),
            torch.full((k,), 1 / k),
            middle,
            torch.zeros(k, k),
        )

    order = torch.randperm(6, generator=generator)
    moved = style(keys[order] + 0.01 * torch.randn(6, 8, generator=generator))
    assert torch.equal(order[matching_regions(style(keys), moved)], torch.arange(6))
    assert matching_regions(style(keys), style(keys[:4])).max() < 4
    assert torch.equal(matching_regions(style(keys[:, :0]), style(keys[:, :0])), torch.zeros(6, dtype=torch.int64))
