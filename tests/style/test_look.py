"""Looks: strengths, regions, luminance and mixes, against their definitions point by point."""

from typing import Annotated

import pytest
import torch
from style_cases import setting
from torch import Tensor

from fprf.interfaces import Decoder, Stylizer
from fprf.plugins.stylizers.config import AdainConfig, RegionOtConfig
from fprf.style.look import Restyle, keep_luminance
from fprf.style.scene_style import Membership, RegionWeight
from fprf.types import Want


class Sigmoid(Decoder):
    """Colours are three of the channels."""

    def forward(self, content: Annotated[Tensor, "N C"]) -> Annotated[Tensor, "N 3"]:
        return torch.sigmoid(content[:, :3])


class Never(Stylizer):
    """Must not be asked."""

    @property
    def needs(self) -> Want:
        raise AssertionError

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        raise AssertionError

    def match(self, semantic: Tensor) -> Tensor:
        raise AssertionError


def test_at_strength_0_nothing_is_asked_for() -> None:
    look = Restyle(Never(), 0.0, luminance=1.0)
    assert look.idle and look.needs == Want.CONTENT
    assert look.mixed(look, 0.5).idle and look.mixed(look, 0.5).needs == Want.CONTENT


def test_kept_regions_stay_bit_for_bit_and_the_others_are_styled() -> None:
    content, semantic, scene, d = setting()
    stylizer = AdainConfig().build(dictionary=d, scene=scene)
    look = Restyle(stylizer, 1.0, RegionWeight(scene, torch.tensor([[0.0], [1.0], [0.5]])), luminance=0.7)
    assert stylizer.needs == Want.CONTENT and look.needs == Want.CONTENT | Want.SEMANTIC
    share = Membership(scene)(semantic)
    decoder = Sigmoid()
    colour, plain = look.colour(decoder, content, semantic), decoder(content)
    kept, full = share[:, 0] == 1, share[:, 1] == 1
    assert int(kept.sum()) > 20 and torch.equal(colour[kept], plain[kept])
    styled = decoder(stylizer(content, None))
    torch.testing.assert_close(colour[full], keep_luminance(styled, plain, 0.7)[full], rtol=0.0, atol=1e-6)
    expected = share @ torch.tensor([0.0, 1.0, 0.5])
    match = look.match(semantic)
    torch.testing.assert_close(match.sum(1), expected, rtol=0.0, atol=1e-5)
    assert float(match[kept].abs().max()) == 0


@pytest.mark.parametrize("at", [0.25, 0.5])
def test_between_two_styles_features_strengths_and_luminances_are_linear(at: float) -> None:
    content, semantic, scene, d = setting()
    a = Restyle(AdainConfig().build(dictionary=d, scene=scene), 0.8, luminance=0.2)
    weight = RegionWeight(scene, torch.tensor([[0.0], [1.0], [1.0]]))
    b = Restyle(RegionOtConfig().build(dictionary=d, scene=scene), 1.0, weight, luminance=0.6)
    mixed = a.mixed(b, at)
    assert mixed.needs == Want.CONTENT | Want.SEMANTIC
    decoder, plain = Sigmoid(), Sigmoid()(content)
    strength = 0.8, Membership(scene)(semantic) @ torch.tensor([[0.0], [1.0], [1.0]])
    features = [content + s * (x.stylizer(content, semantic) - content) for x, s in zip((a, b), strength, strict=True)]
    wanted = keep_luminance(decoder(torch.lerp(*features, at)), plain, (1 - at) * 0.2 + at * 0.6)
    torch.testing.assert_close(mixed.colour(decoder, content, semantic), wanted, rtol=0.0, atol=1e-5)
    expected = torch.cat([(1 - at) * a.match(semantic), at * b.match(semantic)], 1)
    torch.testing.assert_close(mixed.match(semantic), expected)


def test_a_faded_look_is_the_scene_and_a_mix_with_it_a_strength() -> None:
    content, _, scene, d = setting()
    look = Restyle(AdainConfig().build(dictionary=d, scene=scene), 0.8)
    assert look.faded.idle and look.mixed(look, 0.5).faded.idle
    half, wanted = look.faded.mixed(look, 0.5), Restyle(look.stylizer, 0.4)
    colours = [each.colour(Sigmoid(), content, None) for each in (half, wanted)]
    torch.testing.assert_close(*colours, rtol=0.0, atol=1e-5)
