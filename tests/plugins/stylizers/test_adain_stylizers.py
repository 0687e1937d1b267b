"""Global and local AdaIN against the paper's equations, written out in float64."""

import pytest
import torch
from style_cases import points, references, scene_of, setting

from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig
from fprf.style.dictionary import build_dictionary
from fprf.style.matching import score_spread, share_mean, unit
from fprf.style.scene_style import own_style
from fprf.types import Want


@pytest.mark.parametrize("offset", [0.0, 1e2, 1e4])
@pytest.mark.parametrize("spread", [1e-4, 1.0, 1e4])
def test_adain_is_the_papers_equation_over_all_reference_pixels(offset: float, spread: float) -> None:
    """Large means cost no digits but those that the features themselves have lost."""
    content, semantic = points()
    content, refs = (content + offset) * spread, references(1.0, 3.0)
    stylizer = AdainConfig().build(dictionary=build_dictionary(refs, clusters=3), scene=scene_of(content, semantic))
    assert stylizer.needs == Want.CONTENT
    f = content.double()
    pixels = torch.cat([refs[0].content, *[refs[1].content] * 3]).double()
    expected = pixels.std(0, correction=0) * (f - f.mean(0)) / f.std(0, correction=0) + pixels.mean(0)
    torch.testing.assert_close(stylizer(content, None).double(), expected, rtol=1e-5, atol=1e-4 + 1e-6 * offset)


@pytest.mark.parametrize("similarity", ["cosine", "dot"])
@pytest.mark.parametrize("temperature", [0.05, 0.4, 10.0])
def test_local_adain_is_the_papers_equations(similarity: str, temperature: float) -> None:
    content, semantic, scene, d = setting()
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


def test_the_scenes_own_style_gives_the_scene() -> None:
    content, semantic = points()
    content[:, 2] = 3.0
    content[:, 3] *= 1e-4
    scene = scene_of(content, semantic)
    out = AdainConfig().build(dictionary=own_style(scene), scene=scene)(content, None)
    assert float((out - content).abs().max() / content.abs().max()) < 1e-5
