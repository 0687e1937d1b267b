"""Wishes by composition: each region by the stylizer of the references that it may take from."""

import pytest
import torch
from style_cases import points, references, scene_of, setting
from two_sided import region_adain

from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    StylizerConfig,
)
from fprf.plugins.stylizers.region import TwoSidedStylizer
from fprf.style.dictionary import build_dictionary, choose, whole_style
from fprf.style.look import regional
from fprf.style.scene_style import Membership
from fprf.types import Want

ALL = (AdainConfig(), LocalAdainConfig(), region_adain(), RegionOtConfig())


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


@pytest.mark.parametrize("config", ALL)
def test_each_region_is_styled_by_what_it_may_take_from(config: StylizerConfig) -> None:
    """Those that are made of regions apply the choice themselves: each map is the one that it has with these references."""
    content, semantic, scene, d = setting(1.0, 2.0, 3.0, clusters=2)
    allowed = torch.tensor([[True, False, False], [True, True, True], [False, True, True]])
    made = regional(d, scene, allowed, config)
    assert made.needs == Want.CONTENT | Want.SEMANTIC
    assert isinstance(made, TwoSidedStylizer) == config.handles_allowed_references
    share = Membership(scene)(semantic)
    out, match = torch.zeros_like(content), torch.zeros(300, len(d.keys))
    for k in range(3):
        part, codes = choose(d, allowed[k])
        alone = config.build(dictionary=part, scene=scene)
        if isinstance(alone, TwoSidedStylizer):
            only = torch.nn.functional.one_hot(torch.full((300,), k), 3).float()
            styled, taken = alone.maps(content, only, alone.centre), alone.table[k]
        else:
            styled, taken = alone(content, semantic), alone.match(semantic)
        out += share[:, k, None] * styled
        match[:, codes] += share[:, k, None] * taken
    torch.testing.assert_close(made(content, semantic), out, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(made.match(semantic), match, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(made.match(semantic).sum(1), torch.ones(300), rtol=0.0, atol=1e-5)
    for i in range(3):  # what no region of a point may take has no share, not even a small one
        banned = (share * allowed[:, i]).sum(1) == 0
        assert float(made.match(semantic)[banned][:, d.reference == i].sum()) == 0.0


@pytest.mark.parametrize("config", ALL)
def test_one_choice_for_all_regions_is_the_stylizer_of_those_references(config: StylizerConfig) -> None:
    content, semantic, scene, d = setting(1.0, 2.0, 3.0, clusters=2)
    allowed = torch.tensor([[False, True, False]] * 3)
    made = regional(d, scene, allowed, config)
    alone = config.build(dictionary=choose(d, allowed[0])[0], scene=scene)
    given = semantic if Want.SEMANTIC in made.needs else None
    assert made.needs == alone.needs
    torch.testing.assert_close(made(content, given), alone(content, given), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(made.match(semantic)[:, d.reference == 1], alone.match(semantic), rtol=0.0, atol=1e-6)


def test_a_scene_without_semantics_can_be_pinned_as_a_whole() -> None:
    content, _ = points()
    scene = scene_of(content, None, 8)
    d = build_dictionary([r._replace(semantic=torch.zeros(300, 0)) for r in references(1.0, 1.0)])
    allowed = torch.tensor([[False, True]])
    alone, _ = choose(d, allowed[0])
    for config in (AdainConfig(), region_adain(gain=1e6)):
        made = regional(d, scene, allowed, config)
        assert made.needs == Want.CONTENT
        torch.testing.assert_close(made(content, None).double().mean(0), whole_style(alone)[0], rtol=1e-4, atol=1e-4)
        assert made.match(content[:2, :0]).tolist() == [[0.0, 1.0]] * 2
