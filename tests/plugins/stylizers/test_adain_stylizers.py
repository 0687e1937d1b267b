"""Global and local AdaIN against the paper's equations, written out in float64."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.errors import DataError
from fprf.plugins.stylizers.config import AdainConfig, IdentityConfig, LocalAdainConfig, StylizerConfig
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary
from fprf.style.matching import score_spread, share_mean, unit
from fprf.style.scene import SceneStyle, own_style, scene_style
from fprf.types import Want

PAPER = LocalAdainConfig(similarity="dot", centred=False, relative=False, temperature=1.0)
ALL = (IdentityConfig(), AdainConfig(), LocalAdainConfig(), LocalAdainConfig(similarity="dot"), PAPER)


def points(n: int = 400, c: int = 6, d: int = 4, *, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    kind = torch.randint(0, 3, (n,), generator=g)
    content = torch.randn(3, c, generator=g)[kind] * 2 + torch.randn(n, c, generator=g) * (kind[:, None] + 1) + 5
    return content, torch.eye(3, d)[kind] * 3 + torch.randn(n, d, generator=g) * 0.2 + 1


def scene_of(content: torch.Tensor, semantic: torch.Tensor | None, regions: int = 3) -> SceneStyle:
    return scene_style(content, semantic, torch.ones(len(content)), None, regions, 0)


def references(*weights: float) -> list[Reference]:
    return [Reference(f"r{i}", *points(seed=7 + i), weight=w) for i, w in enumerate(weights)]


def test_adain_is_the_papers_equation_over_all_reference_pixels() -> None:
    content, semantic = points()
    refs = references(1.0, 3.0)
    stylizer = AdainConfig().build(dictionary=build_dictionary(refs, clusters=3), scene=scene_of(content, semantic))
    assert stylizer.needs == Want.CONTENT
    f = content.double()
    pixels = torch.cat([refs[0].content, *[refs[1].content] * 3]).double()
    expected = pixels.std(0, correction=0) * (f - f.mean(0)) / f.std(0, correction=0) + pixels.mean(0)
    torch.testing.assert_close(stylizer(content, None).double(), expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("similarity", ["cosine", "dot"])
@pytest.mark.parametrize("temperature", [0.05, 0.4, 10.0])
def test_local_adain_is_the_papers_equations(similarity: str, temperature: float) -> None:
    content, semantic = points()
    scene, d = scene_of(content, semantic), build_dictionary(references(1.0, 1.0), clusters=3)
    stylizer = LocalAdainConfig(similarity=similarity, temperature=temperature).build(dictionary=d, scene=scene)
    assert stylizer.needs == Want.CONTENT | Want.SEMANTIC
    queries, keys, regions = semantic.double(), d.keys.double(), scene.keys.double()
    if similarity == "cosine":
        keys = unit(keys, share_mean(keys, d.share.double()))
        queries, regions = (unit(q, scene.semantic_mean.double()) for q in (queries, regions))
    # R = F_DINO F_DINO(I_s)^T, R^S = Softmax(R), M_w = R^S M, Sigma_w = R^S Sigma (Eq. 5, 6)
    r = torch.stack([torch.stack([(q * k).sum() for k in keys]) for q in queries])
    r_s = torch.softmax(r / (temperature * score_spread(regions, keys)), 1)
    sigma = d.covariance.double().diagonal(dim1=1, dim2=2).sqrt()
    m_w, sigma_w = r_s @ d.mean.double(), r_s @ sigma
    mu_c, sigma_c = scene.mean.double(), scene.covariance.double().diagonal().sqrt()
    expected = sigma_w * (content.double() - mu_c) / sigma_c + m_w
    torch.testing.assert_close(stylizer.match(semantic).double(), r_s, rtol=0.0, atol=2e-5)
    torch.testing.assert_close(stylizer(content, semantic).double(), expected, rtol=1e-4, atol=2e-4)


@pytest.mark.parametrize("config", ALL)
def test_the_order_of_the_references_plays_no_part(config: StylizerConfig) -> None:
    content, semantic = points()
    scene, refs = scene_of(content, semantic), references(1.0, 2.0, 0.5)
    a = config.build(dictionary=build_dictionary(refs), scene=scene)(content, semantic)
    b = config.build(dictionary=build_dictionary(refs[::-1]), scene=scene)(content, semantic)
    assert torch.equal(a, b)


def test_the_scenes_own_style_gives_the_scene() -> None:
    content, semantic = points()
    content[:, 2] = 3.0
    content[:, 3] *= 1e-4
    scene = scene_of(content, semantic)
    out = AdainConfig().build(dictionary=own_style(scene), scene=scene)(content, None)
    assert float((out - content).abs().max() / content.abs().max()) < 1e-5


@pytest.mark.parametrize("offset", [0.0, 1e2, 1e4])
@pytest.mark.parametrize("spread", [1e-4, 1.0, 1e4])
def test_large_means_cost_no_digits(offset: float, spread: float) -> None:
    content = torch.randn(500, 3) * spread + offset * spread
    semantic = torch.randn(500, 2)
    style = Reference("s", torch.randn(500, 3), semantic)
    stylizer = AdainConfig().build(dictionary=build_dictionary([style], clusters=1), scene=scene_of(content, semantic))
    mean, gain, aim = (t.double() for t in (stylizer.content_mean, stylizer.gain, stylizer.style_mean))
    expected = (content.double() - mean) * gain + aim
    bound = 8 * 6e-8 * (1 + expected.abs().max())
    assert float((stylizer(content, None).double() - expected).abs().max()) < bound


@settings(max_examples=20, deadline=None)
@given(
    st.integers(1, 20),
    st.sampled_from([0.0, 1e-6, 1.0, 1e4]),
    st.sampled_from([0.0, 1e-6, 1.0, 1e4]),
    st.sampled_from(ALL),
)
def test_never_nan_for_degenerate_scenes_and_styles(n: int, here: float, there: float, config: StylizerConfig) -> None:
    content, semantic = torch.randn(n, 4) * here + 3, torch.randn(n, 3) * here
    d = build_dictionary([Reference("a", torch.randn(n, 4) * there, torch.randn(n, 3) * there)])
    out = config.build(dictionary=d, scene=scene_of(content, semantic))(content, semantic)
    assert bool(out.isfinite().all())


def test_other_encoders_references_are_refused() -> None:
    content, semantic = points()
    d: StyleDictionary = build_dictionary([Reference("a", torch.randn(9, 5), torch.randn(9, 4))])
    for config in ALL[2:]:
        with pytest.raises(DataError, match="5 content and 4 semantic channels"):
            config.build(dictionary=d, scene=scene_of(content, semantic))
