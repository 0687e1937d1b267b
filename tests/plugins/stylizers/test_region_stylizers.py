"""Two-sided stylizers against their definition, written out in float64; identity and limits."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from style_cases import points, region_adain, scene_of, setting

from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, RegionToneConfig, StylizerConfig
from fprf.plugins.stylizers.region import region_table
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary
from fprf.style.matching import score_spread, share_mean, unit
from fprf.style.scene_style import Membership, SceneStyle, own_style
from fprf.style.statistics import deviation, monge
from fprf.types import Want

BOTH = (region_adain, RegionOtConfig)
CONFIG = region_adain(whitening=0.0, recentred=0)
PAPER = LocalAdainConfig(similarity="dot", centred=False, relative=False, temperature=1.0)
Config = Callable[..., StylizerConfig]


def plain_table(scene: SceneStyle, d: StyleDictionary, temperature: float) -> torch.Tensor:
    q = unit(scene.keys.double(), share_mean(scene.keys.double(), scene.share.double()))
    k = unit(d.keys.double(), share_mean(d.keys.double(), d.share.double()))
    return torch.softmax(q @ k.T / (temperature * score_spread(q, k)), 1)


@pytest.mark.parametrize("config", BOTH)
@pytest.mark.parametrize("temperature", [0.1, 0.4, 5.0])
def test_the_map_is_its_definition(config: Config, temperature: float) -> None:
    content, semantic, scene, d = setting(n=600)
    stylizer = config(temperature=temperature, whitening=0.0, recentred=0).build(dictionary=d, scene=scene)
    assert stylizer.needs == Want.CONTENT | Want.SEMANTIC
    share = Membership(scene.keys, scene.semantic_mean)(semantic).double()
    own = own_style(scene, d.blend)
    here, there = plain_table(scene, own, temperature), plain_table(scene, d, temperature)
    f, expected = content.double(), torch.zeros(600, 6, dtype=torch.float64)
    for k in range(len(scene.keys)):
        mean_c, mean_s = (t[k] @ x.mean.double() for t, x in ((here, own), (there, d)))
        if config is RegionOtConfig:
            cov_c, cov_s = (torch.einsum("t,tij->ij", t[k], x.covariance.double()) for t, x in ((here, own), (there, d)))
            a = monge(cov_c, cov_s, gain=8.0)
        else:
            sigma_c, sigma_s = (
                t[k] @ deviation(x.mean, x.covariance.diagonal(dim1=1, dim2=2)).double() for t, x in ((here, own), (there, d))
            )
            a = (sigma_s / sigma_c).diag()
        expected += share[:, k, None] * ((f - mean_c) @ a + mean_s)
    torch.testing.assert_close(stylizer(content, semantic).double(), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(stylizer.match(semantic).double(), share @ there, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("config", BOTH)
@pytest.mark.parametrize("regions", [1, 3, 9])
@pytest.mark.parametrize("temperature", [0.05, 0.4, 20.0])
@pytest.mark.parametrize("blend", [0.0, 0.3, 1.0])
def test_the_scenes_own_style_is_the_identity(config: Config, regions: int, temperature: float, blend: float) -> None:
    content, semantic = points(600)
    content[:, 1] *= 1e-3
    content[:, 2] = 4.0
    scene = scene_of(content, semantic, regions)
    scene = scene._replace(contacts=torch.full_like(scene.contacts, 0.1))
    for smoothness in (0.0, 5.0):
        made = config(temperature=temperature, smoothness=smoothness).build(dictionary=own_style(scene, blend), scene=scene)
        out = made(content, semantic)
        assert float((out - content).abs().max() / content.abs().max()) < 1e-5


@pytest.mark.parametrize("config", BOTH)
def test_smoothness_makes_regions_alike_that_meet(config: Config) -> None:
    _, _, scene, d = setting(n=600)
    contacts = torch.zeros(3, 3)
    contacts[0, 1] = contacts[1, 0] = 0.1
    scene = scene._replace(contacts=contacts)
    tables = [config(smoothness=s).build(dictionary=d, scene=scene).get_buffer("table") for s in (0.0, 2.0, 1e6)]
    apart = [float((table[0] - table[1]).abs().sum()) for table in tables]
    assert apart[0] > 0.1 and apart[0] > apart[1] > apart[2] and apart[2] < 1e-4
    torch.testing.assert_close(tables[2][2], tables[0][2], msg="region 2 meets none")
    pinned = d._replace(allowed=torch.tensor([[True, False], [True, True], [True, True]]))
    alone = [config(smoothness=s).build(dictionary=pinned, scene=scene).get_buffer("table")[0] for s in (0.0, 1e6)]
    assert torch.equal(*alone), "what is pinned takes from no neighbour that is not"


@pytest.mark.parametrize("like", [0, 1])
def test_a_region_that_no_reference_shows_takes_the_codes_of_one_that_looks_like_it(like: int) -> None:
    _, _, scene, d = setting(n=600)
    other = 1 - like
    near = d._replace(keys=scene.keys[torch.arange(len(d.keys)) % 2])
    mean = scene.region_mean.clone()
    mean[2] = mean[like]
    mean[other] = mean[like] + 100.0
    shown = region_table(scene._replace(region_mean=mean), near, CONFIG)
    torch.testing.assert_close(shown[2], shown[like], rtol=0.0, atol=1e-6)
    assert float((shown[2] - shown[other]).abs().sum()) > 0.5
    torch.testing.assert_close(shown[:2], plain_table(scene, near, 0.4)[:2], rtol=1e-6, atol=1e-9)
    alone = region_table(scene._replace(share=torch.tensor([0.0, 0.0, 1.0])), near, CONFIG)
    assert bool(alone.isfinite().all()), "no region to take from"


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 25),
    st.integers(1, 12),
    st.integers(1, 12),
    st.sampled_from([0.0, 1e-6, 1.0, 1e4]),
    st.sampled_from([0.0, 1e-6, 1.0, 1e4]),
    st.sampled_from([AdainConfig(), LocalAdainConfig(), PAPER, region_adain(), RegionOtConfig(), RegionToneConfig()]),
)
def test_never_nan_for_degenerate_scenes_and_styles(
    n: int, regions: int, clusters: int, here: float, there: float, config: StylizerConfig
) -> None:
    content, semantic = torch.randn(n, 4) * here + 3, torch.randn(n, 3) * here
    d = build_dictionary([Reference("a", torch.randn(n, 4) * there, torch.randn(n, 3) * there)], clusters=clusters)
    scene = scene_of(content, semantic, regions)
    made = config.build(dictionary=d, scene=scene)
    for rows in (n, 1, 0):
        out = made(content[:rows], semantic[:rows])
        assert out.shape == (rows, 4) and bool(out.isfinite().all())
