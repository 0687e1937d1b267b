"""Wishes by composition: each region by the stylizer of the references that it may take from."""

import pytest
import torch

from fprf.plugins.stylizers.config import (
    AdainConfig,
    IdentityConfig,
    LocalAdainConfig,
    RegionAdainConfig,
    RegionOtConfig,
    StylizerConfig,
)
from fprf.plugins.stylizers.region import TwoSidedStylizer
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary, choose, whole_style
from fprf.style.regional import regional
from fprf.style.scene import Membership, SceneStyle, scene_style
from fprf.types import Want

ALL = (IdentityConfig(), AdainConfig(), LocalAdainConfig(), RegionAdainConfig(), RegionOtConfig())


def points(n: int = 300, *, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    kind = torch.randint(0, 3, (n,), generator=g)
    content = torch.randn(3, 6, generator=g)[kind] * 2 + torch.randn(n, 6, generator=g) * (kind[:, None] + 1) + 5
    return content, torch.eye(3, 4)[kind] * 3 + torch.randn(n, 4, generator=g) * 0.5 + 1


def setting() -> tuple[torch.Tensor, torch.Tensor, SceneStyle, StyleDictionary]:
    content, semantic = points()
    scene = scene_style(content, semantic, torch.ones(300), None, 3, 0)
    d = build_dictionary([Reference(f"r{i}", *points(seed=5 + i), i + 1.0) for i in range(3)], clusters=2)
    return content, semantic, scene, d


def test_a_dictionary_of_some_references_is_the_one_built_of_them() -> None:
    refs = [Reference(f"r{i}", *points(seed=5 + i), i + 1.0) for i in range(4)]
    d = build_dictionary(refs, clusters=3)
    chosen = torch.tensor([True, False, True, True])
    part, codes = choose(d, chosen)
    names = [name for name, taken in zip(d.names, chosen, strict=True) if taken]
    expected = build_dictionary([r for r in refs if r.name in names], clusters=3)
    assert part.names == expected.names and part.blend == expected.blend
    assert all(torch.equal(a, b) for a, b in zip(part[:6], expected[:6], strict=True))
    assert torch.equal(codes, chosen[d.reference])


@pytest.mark.parametrize("config", ALL[:3])
def test_each_region_is_styled_by_what_it_may_take_from(config: StylizerConfig) -> None:
    content, semantic, scene, d = setting()
    allowed = torch.tensor([[True, False, False], [True, True, True], [False, True, True]])
    made = regional(d, scene, allowed, config)
    assert made.needs == Want.CONTENT | Want.SEMANTIC
    share = Membership(scene)(semantic)
    out, match = torch.zeros_like(content), torch.zeros(300, len(d.keys))
    for k in range(3):
        part, codes = choose(d, allowed[k])
        alone = config.build(dictionary=part, scene=scene)
        out += share[:, k, None] * alone(content, semantic)
        match[:, codes] += share[:, k, None] * alone.match(semantic)
    torch.testing.assert_close(made(content, semantic), out, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(made.match(semantic), match, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(made.match(semantic).sum(1), torch.ones(300), rtol=0.0, atol=1e-5)
    # What no region of a point may take has no share, not even a small one.
    banned = share @ (~allowed).float() == share.sum(1, keepdim=True)
    for i in range(3):
        assert float(made.match(semantic)[banned[:, i]][:, d.reference == i].sum()) == 0.0


@pytest.mark.parametrize("config", ALL[3:])
def test_stylizers_made_of_regions_heed_the_choice_themselves(config: StylizerConfig) -> None:
    """Each region's map is the one that it has with the references that it may take from, and no other."""
    content, semantic, scene, d = setting()
    allowed = torch.tensor([[True, False, False], [True, True, True], [False, True, True]])
    made = regional(d, scene, allowed, config)
    assert isinstance(made, TwoSidedStylizer)
    share = Membership(scene)(semantic)
    out, match = torch.zeros_like(content), torch.zeros(300, len(d.keys))
    for k in range(3):
        part, codes = choose(d, allowed[k])
        alone = config.build(dictionary=part, scene=scene)
        assert isinstance(alone, TwoSidedStylizer)
        only = torch.nn.functional.one_hot(torch.full((300,), k), 3).float()
        out += share[:, k, None] * alone.maps(content, only, alone.centre)
        match[:, codes] += share[:, k, None] * alone.table[k]
    torch.testing.assert_close(made(content, semantic), out, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(made.match(semantic), match, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(made.match(semantic).sum(1), torch.ones(300), rtol=0.0, atol=1e-5)
    for i in range(3):
        banned = (share * allowed[:, i]).sum(1) == 0
        assert float(made.match(semantic)[banned][:, d.reference == i].sum()) == 0.0


@pytest.mark.parametrize("config", ALL)
def test_one_choice_for_all_regions_is_the_stylizer_of_those_references(config: StylizerConfig) -> None:
    content, semantic, scene, d = setting()
    allowed = torch.tensor([[False, True, False]] * 3)
    made = regional(d, scene, allowed, config)
    alone = config.build(dictionary=choose(d, allowed[0])[0], scene=scene)
    given = semantic if Want.SEMANTIC in made.needs else None
    assert made.needs == alone.needs
    torch.testing.assert_close(made(content, given), alone(content, given), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(made.match(semantic)[:, d.reference == 1], alone.match(semantic), rtol=0.0, atol=1e-6)


def test_a_scene_without_semantics_can_be_pinned_as_a_whole() -> None:
    content, _ = points()
    scene = scene_style(content, None, torch.ones(300), None, 8, 0)
    d = build_dictionary([Reference(f"r{i}", points(seed=5 + i)[0], torch.zeros(300, 0)) for i in range(2)])
    allowed = torch.tensor([[False, True]])
    alone, _ = choose(d, allowed[0])
    for config in (AdainConfig(), RegionAdainConfig(gain=1e6)):
        made = regional(d, scene, allowed, config)
        assert made.needs == Want.CONTENT
        torch.testing.assert_close(made(content, None).double().mean(0), whole_style(alone)[0], rtol=1e-4, atol=1e-4)
        assert made.match(content[:2, :0]).tolist() == [[0.0, 1.0]] * 2
