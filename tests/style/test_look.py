"""Looks: strengths, regions, luminance and mixes, against their definitions point by point."""

from typing import Annotated

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from style_cases import points, references, region_adain, scene_of, setting
from torch import Tensor

from fprf.interfaces import Decoder, Stylizer
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, StylizerConfig
from fprf.plugins.stylizers.region import TwoSidedStylizer
from fprf.style.config import parse_place
from fprf.style.dictionary import build_dictionary, choose, whole_style
from fprf.style.light import luma
from fprf.style.look import Restyle, keep_luminance, place_weight, regional
from fprf.style.scene_style import Membership, RegionWeight
from fprf.types import Want

COLOUR = st.tuples(
    *[
        st.sampled_from([0.0, 1e-7, 0.2, 0.5, 1 / 3, 0.999, 1.0])
        | st.floats(0, 1, width=32, allow_subnormal=False)
    ]
    * 3
)


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
    share = Membership(scene.keys, scene.semantic_mean)(semantic)
    decoder = Sigmoid()
    colour = look.colour(decoder, content, semantic)
    plain = decoder(content)
    kept = share[:, 0] == 1
    full = share[:, 1] == 1
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
    decoder = Sigmoid()
    plain = Sigmoid()(content)
    strength = (
        0.8,
        Membership(scene.keys, scene.semantic_mean)(semantic) @ torch.tensor([[0.0], [1.0], [1.0]]),
    )
    features = [
        content + s * (x.stylizer(content, semantic) - content) for x, s in zip((a, b), strength, strict=True)
    ]
    wanted = keep_luminance(decoder(torch.lerp(*features, at)), plain, (1 - at) * 0.2 + at * 0.6)
    torch.testing.assert_close(mixed.colour(decoder, content, semantic), wanted, rtol=0.0, atol=1e-5)
    expected = torch.cat([(1 - at) * a.match(semantic), at * b.match(semantic)], 1)
    torch.testing.assert_close(mixed.match(semantic), expected)


@settings(max_examples=200, deadline=None)
@given(COLOUR, COLOUR, st.sampled_from([0.0, 0.3, 1.0]))
@example((0.0, 0.0, 1.1754943508222875e-38), (0.0, 0.0, 0.0), 0.0)
def test_kept_luminance_is_the_scenes_and_colours_stay_colours(
    styled: tuple[float, float, float], own: tuple[float, float, float], share: float
) -> None:
    a = torch.tensor([styled])
    b = torch.tensor([own])
    out = keep_luminance(a, b, share)
    assert float(out.min()) >= 0 and float(out.max()) <= 1
    # Rounding: a handful of float32 operations on numbers up to 1, and the tint's share of the clamp.
    wanted = luma(a.double()) + share * (luma(b.double()) - luma(a.double()))
    torch.testing.assert_close(luma(out.double()), wanted, rtol=0.0, atol=2e-6)
    if share == 0 or styled == own:
        assert torch.equal(out, a), "bit for bit"


def test_hues_survive_where_there_is_room_and_fade_where_not() -> None:
    orange, bright, dark = (torch.tensor([c]) for c in ((0.6, 0.4, 0.2), (0.55, 0.5, 0.45), (0.0, 0.0, 0.0)))
    moved = keep_luminance(orange, bright, 1.0)
    torch.testing.assert_close(moved - luma(moved), orange - luma(orange), rtol=0.0, atol=1e-6)
    white = keep_luminance(orange, torch.ones(1, 3), 1.0)
    torch.testing.assert_close(white, torch.ones(1, 3))
    assert torch.equal(keep_luminance(orange, dark, 1.0), dark)
    # Too light for so strong a tint: the direction of the tint is the same, its length is what fits.
    light = keep_luminance(torch.tensor([[1.0, 0.0, 0.0]]), torch.full((1, 3), 0.9), 1.0)
    tint = (light - luma(light))[0]
    full = torch.tensor([1.0, 0.0, 0.0]) - 0.2126
    torch.testing.assert_close(
        torch.linalg.vecdot(tint, full), tint.norm() * full.norm(), rtol=1e-5, atol=0.0
    )
    assert float(light.amax()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "box:0,-1,-1:1,1,1:0.5",
            [1.0, 0.84375, 0.5, 0.0, 1.0],
        ),  # a smoothstep from the border's inside to its outside
        ("box:1,1,1:0,-1,-1", [1.0, 0.0, 0.0, 0.0, 1.0]),
        ("path:-1,0,0:0.5,0,0:0.5,2,0:1,0.5", [1.0, 0.84375, 0.5, 0.0, 1.0]),
        ("everywhere", [1.0] * 5),
    ],
)
def test_a_place_is_full_inside_and_fades_over_its_border(text: str, expected: list[float]) -> None:
    place = parse_place("pin", text)
    assert place is not None and parse_place("pin", "3") is None
    points = torch.tensor(
        [[0.5, 0.0, 0.0], [1.125, 0.0, 0.0], [1.25, 0.0, 0.0], [1.6, 0.0, 0.0], [0.4, 0.9, 0.0]]
    )
    assert place_weight(place, points).tolist() == pytest.approx(expected)


STYLIZERS = (AdainConfig(), LocalAdainConfig(), region_adain(), RegionOtConfig())


def test_a_dictionary_of_some_references_is_the_one_built_of_them() -> None:
    refs = references(1.0, 2.0, 3.0, 4.0)
    d = build_dictionary(refs, clusters=3)
    chosen = torch.tensor([True, False, True, True])
    part, codes = choose(d, chosen)
    names = [name for name, taken in zip(d.names, chosen, strict=True) if taken]
    expected = build_dictionary([r for r in refs if r.name in names], clusters=3)
    assert part.names == expected.names and part.blend == expected.blend
    assert all(torch.equal(a, b) for a, b in zip(part[:6], expected[:6], strict=True))
    assert torch.equal(codes, chosen[d.reference])


@pytest.mark.parametrize("config", STYLIZERS)
def test_each_region_is_styled_by_what_it_may_take_from(config: StylizerConfig) -> None:
    """Those that are made of regions apply the choice themselves: each map is the one that it has with these
    references.
    """
    content, semantic, scene, d = setting(1.0, 2.0, 3.0, clusters=2)
    allowed = torch.tensor([[True, False, False], [True, True, True], [False, True, True]])
    made = regional(d, scene, allowed, config)
    assert made.needs == Want.CONTENT | Want.SEMANTIC
    assert isinstance(made, TwoSidedStylizer) == config.handles_allowed_references
    share = Membership(scene.keys, scene.semantic_mean)(semantic)
    out = torch.zeros_like(content)
    match = torch.zeros(300, len(d.keys))
    for k in range(3):
        part, codes = choose(d, allowed[k])
        alone = config.build(dictionary=part, scene=scene)
        if isinstance(alone, TwoSidedStylizer):
            away = content - alone.centre
            moved = away * alone.matrix[k] if alone.matrix.ndim == 2 else away @ alone.matrix[k]
            styled = moved + alone.bias[k]
            taken = alone.table[k]
        else:
            styled = alone(content, semantic)
            taken = alone.match(semantic)
        out += share[:, k, None] * styled
        match[:, codes] += share[:, k, None] * taken
    torch.testing.assert_close(made(content, semantic), out, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(made.match(semantic), match, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(made.match(semantic).sum(1), torch.ones(300), rtol=0.0, atol=1e-5)
    for i in range(3):  # what no region of a point may take has no share, not even a small one
        banned = (share * allowed[:, i]).sum(1) == 0
        assert float(made.match(semantic)[banned][:, d.reference == i].sum()) == 0.0


def test_a_scene_without_semantics_can_be_pinned_as_a_whole() -> None:
    content, _ = points()
    scene = scene_of(content, None, 8)
    d = build_dictionary([r._replace(semantic=torch.zeros(300, 0)) for r in references(1.0, 1.0)])
    allowed = torch.tensor([[False, True]])
    alone, _ = choose(d, allowed[0])
    for config in (AdainConfig(), region_adain(gain=1e6)):
        made = regional(d, scene, allowed, config)
        assert made.needs == Want.CONTENT
        torch.testing.assert_close(
            made(content, None).double().mean(0), whole_style(alone)[0], rtol=1e-4, atol=1e-4
        )
        assert made.match(content[:2, :0]).tolist() == [[0.0, 1.0]] * 2
