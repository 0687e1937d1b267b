from dataclasses import replace

import pytest
import torch

from fprf.errors import UsageError
from fprf.page.drawing import Restyler, matching_regions
from fprf.page.state import Look, Photograph
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.look import Restyle
from fprf.style.regions import Regions, membership_view
from fprf.style.restyle import apply_style
from fprf.training.views import render_view


def rendered(restyler: Restyler, restyle: Restyle | None) -> torch.Tensor:
    trained = restyler.scene
    return render_view(trained.model, trained.known.facts, trained.known.cameras, 2, trained.config.render, restyle).rgb


def test_a_look_is_the_style_that_the_command_line_makes(restyler: Restyler, encoded: tuple[Photograph, Photograph]) -> None:
    a, b = encoded
    style = StyleConfig(strength=0.8, clusters=3, luminance=0.2)
    look = Look(mix=((a, 1.0), (b, 0.5)), style=style).ruled(1, "pin", b)
    wanted = apply_style(restyler.scene, StyleFile(look.config()))
    assert torch.allclose(rendered(restyler, restyler.restyle(look)), rendered(restyler, wanted.restyle), atol=2e-5)


def test_styles_are_kept_and_bounded(restyler: Restyler, encoded: tuple[Photograph, Photograph]) -> None:
    first = Look(mix=((encoded[0], 1.0),), style=StyleConfig(clusters=2))
    styled = restyler.styled(first)
    assert restyler.styled(replace(first)) is styled
    for step in range(30):
        restyler.styled(replace(first, style=replace(first.style, strength=0.01 * (step + 1))))
    assert len(restyler._styles) <= 24 and len(restyler._dictionaries) == 1
    restyler.retain(encoded[:1])
    assert restyler._styles and restyler._dictionaries
    restyler.retain([])
    assert not restyler._styles and not restyler._dictionaries


def test_a_pixel_finds_the_region_that_is_there(restyler: Restyler) -> None:
    cameras = restyler.scene.cameras.select(torch.tensor([2]))
    share, _ = membership_view(Regions(restyler.scene, restyler.encoders.scene_style, restyler.encoders.basis), 2, 1000)
    for x, y in ((3, 4), (20, 18), (31, 23)):
        assert restyler.region_at(cameras, (x + 0.5, y + 0.5)) == int(share[y, x].argmax())
    with pytest.raises(UsageError, match="outside"):
        restyler.region_at(cameras, (32.0, 1.0))


def test_regions_are_matched_whatever_their_order(restyler: Restyler) -> None:
    generator = torch.Generator().manual_seed(0)
    keys, noise = torch.randn(2, 6, 8, generator=generator)
    style = restyler.encoders.scene_style._replace(keys=keys, semantic_mean=torch.randn(8, generator=generator))
    order = torch.randperm(6, generator=generator)
    moved = style._replace(keys=keys[order] + 0.01 * noise)
    assert torch.equal(order[matching_regions(style, moved)], torch.arange(6))
    assert matching_regions(style, style._replace(keys=keys[:4])).max() < 4
    blind = style._replace(keys=keys[:, :0])
    assert torch.equal(matching_regions(blind, blind), torch.zeros(6, dtype=torch.int64))
