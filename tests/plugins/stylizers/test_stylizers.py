"""Stylizers against the equations of the paper and their definitions, written out in float64; identity and
limits; the verb.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from style_cases import points, references, region_adain, scene_of, setting
from tiny_world import World
from torch import Tensor

from fprf.cli import main as cli
from fprf.datamanagers.basis import Basis, fit_basis
from fprf.errors import DataError
from fprf.interfaces import Stylizer
from fprf.plugins.stylizers.adain import AdainStylizer
from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    RegionToneConfig,
    StylizerConfig,
)
from fprf.plugins.stylizers.region import region_table
from fprf.style.dictionary import Reference, StyleDictionary, build_dictionary
from fprf.style.look import Restyle
from fprf.style.matching import score_spread, share_mean, unit
from fprf.style.scene_style import Membership, SceneStyle, own_style, scene_style
from fprf.style.statistics import deviation, monge
from fprf.training.field_scene import load_style
from fprf.training.views import render_view
from fprf.types import Want

FORM = LocalAdainConfig(similarity="dot", centred=False, relative=False, temperature=1.0)
KNOBS = {"similarity": "dot", "centred": "False", "relative": "False", "temperature": "1"}
FLAGS = [
    "--stylizer",
    "local-adain",
    "--blend",
    "0",
    *(w for k, v in KNOBS.items() for w in (f"--stylizer.{k}", v)),
]
U = 2.0**-24


def attention(f: Tensor, keys: Tensor) -> Tensor:
    """R = F_DINO F_DINO(I_s)^T (Eq. 5), R^S = Softmax(R)."""
    return torch.softmax(f @ keys.T, 1)


def local_adain(
    content: Tensor, r_s: Tensor, m: Tensor, sigma: Tensor, mu_c: Tensor, sigma_c: Tensor
) -> Tensor:
    """M_w = R^S M, Sigma_w = R^S Sigma (Eq. 6); AdaIN to Sigma_w (F_VGG - mu_c) / sigma_c + M_w."""
    m_w = r_s @ m
    sigma_w = r_s @ sigma
    return sigma_w * (content - mu_c) / sigma_c + m_w


class Case(NamedTuple):
    """Pixels of a scene and of three references of one cluster each; semantics as an encoder gives them, far
    from 0.
    """

    content: Tensor
    semantic: Tensor
    styles: list[Reference]


def case(channels: int = 10) -> Case:
    g = torch.Generator().manual_seed(0)
    middle = torch.randn(channels, generator=g) * 3
    kinds = torch.randn(3, channels, generator=g) * 0.7
    kind = torch.randint(0, 3, (600,), generator=g)
    semantic = middle + kinds[kind] + torch.randn(600, channels, generator=g) * 0.3
    content = torch.randn(600, 6, generator=g) * (kind[:, None] + 1) + 5
    styles = [
        Reference(
            str(i),
            torch.randn(200, 6, generator=g) * (3 - i) + i,
            middle * 0.9 + kinds[i] + torch.randn(200, channels, generator=g) * 0.3,
        )
        for i in range(3)
    ]
    return Case(content, semantic, styles)


def built(
    given: Case, basis: Basis, config: LocalAdainConfig = FORM, *, origin: bool = True
) -> tuple[Stylizer, list[Reference]]:
    """The stylizer on the projected features, and the references in the order of its codes."""
    projected = [r._replace(semantic=basis.project(r.semantic)) for r in given.styles]
    dictionary = build_dictionary(projected, clusters=1, blend=0.0)
    if origin:
        dictionary = dictionary._replace(origin=basis.origin())
    scene = scene_style(
        given.content, basis.project(given.semantic), torch.ones(len(given.content)), None, 3, 0
    )
    return config.build(dictionary=dictionary, scene=scene), [
        given.styles[int(name)] for name in dictionary.names
    ]


def logit_error(f: Tensor, keys: Tensor) -> float:
    """Bound of what rounding changes a score by: projected features (2 (D + 2) u), differences (2 u), sums of
    D products.
    """
    return float((4 * f.shape[1] + 12) * U * f.norm(dim=1).amax() * keys.norm(dim=1).amax())


def test_with_a_basis_of_full_rank_it_is_the_papers_equations_on_the_encoders_own_features() -> None:
    given = case()
    basis = fit_basis(given.semantic, 10)
    stylizer, styles = built(given, basis)
    found = stylizer(given.content, basis.project(given.semantic))
    match = stylizer.match(basis.project(given.semantic))
    content = given.content.double()
    f = given.semantic.double()
    keys = torch.stack([r.semantic.double().mean(0) for r in styles])
    m, sigma = (torch.stack([each(r.content.double()) for r in styles]) for each in (mean, spread))
    r_s = attention(f, keys)
    exact = local_adain(content, r_s, m, sigma, mean(content), spread(content))
    relative = float(torch.tensor(2 * logit_error(f, keys)).expm1())
    assert ((match.double() - r_s).abs() <= relative * r_s + U).all()
    size = r_s @ m.abs() + (r_s @ sigma) * ((content - mean(content)) / spread(content)).abs()
    assert ((found.double() - exact).abs() <= (relative + 16 * U) * size + U * m.abs().amax()).all()
    assert 0.1 < float(r_s.amax(1).mean()) < 0.99 and relative < 1e-3, (
        "scores decide, and neither all nor nothing"
    )


@pytest.mark.parametrize("similarity", ["cosine", "dot"])
def test_the_encoders_zero_plays_no_part_in_centred_matches(similarity: str) -> None:
    given = case()
    basis = fit_basis(given.semantic, 10)
    config = LocalAdainConfig(similarity=similarity)  # type: ignore[arg-type]
    y = basis.project(given.semantic)
    one, other = (built(given, basis, config, origin=known)[0] for known in (True, False))
    assert torch.equal(one.match(y), other.match(y)) and torch.equal(
        one(given.content, y), other(given.content, y)
    )
    assert isinstance(one, AdainStylizer) and one.origin is None


class Transcribed(Stylizer):
    """Eq. 5 and 6 in float64 on a trained run: the field's features lifted to the encoder's channels, codes
    from the file.
    """

    def __init__(self, folder: Path, scene: SceneStyle, basis: Basis) -> None:
        super().__init__()
        codes = {name: table.double() for name, table in load_file(folder / "dictionary.safetensors").items()}
        self.basis = basis
        self.keys = basis.lift(codes["keys"])
        self.codes = codes["mean"], codes["covariance"].diagonal(dim1=1, dim2=2).sqrt()
        self.own = scene.mean.double(), scene.covariance.double().diagonal().sqrt()

    needs = Want.CONTENT | Want.SEMANTIC  # type: ignore[assignment]

    def match(self, semantic: Tensor) -> Tensor:
        return attention(self.basis.lift(semantic.double()), self.keys)

    def forward(self, content: Tensor, semantic: Tensor | None) -> Tensor:
        assert semantic is not None
        return local_adain(content.double(), self.match(semantic), *self.codes, *self.own).to(content)


def test_the_verb_draws_the_papers_equations(world: World, tmp_path: Path) -> None:
    """Within a level of 255; the default form differs from it by many."""
    pictures = []
    for name, flags in (("paper", FLAGS), ("default", ["--stylizer", "local-adain", "--blend", "0"])):
        words = [
            "--references",
            *map(str, world.references),
            "--clusters",
            "3",
            "--views",
            "0002",
            "--device",
            "cpu",
        ]
        assert cli.main(["stylize", str(world.run), *words, "--output", str(tmp_path / name), *flags]) == 0
        found = cv2.imread(str(tmp_path / name / "0002.png"))
        pictures.append(torch.from_numpy(found[..., ::-1].copy()).double())
    trained = world.load()
    scene, basis = load_style(trained.run)
    assert basis is not None
    look = Restyle(Transcribed(tmp_path / "paper", scene, basis))
    known = trained.known
    view = known.names.index("0002")
    exact = (
        render_view(trained.model, known.facts, known.cameras, view, trained.config.render, look).rgb.double()
        * 255
    )
    assert (pictures[0] - exact).abs().amax() <= 0.5 + 1e-2
    assert (pictures[1] - exact).abs().amax() > 3


def mean(x: Tensor) -> Tensor:
    return x.mean(0)


def spread(x: Tensor) -> Tensor:
    return x.std(0, correction=0)


@pytest.mark.parametrize(
    "knob", [{"centred": True}, {"relative": True}, {"similarity": "cosine"}, {"temperature": 100.0}]
)
def test_each_part_of_the_form_decides_matches(knob: dict[str, object]) -> None:
    given = case()
    basis = fit_basis(given.semantic, 10)
    y = basis.project(given.semantic)
    other, _ = built(given, basis, replace(FORM, **knob))  # type: ignore[arg-type]
    assert (other.match(y) - built(given, basis)[0].match(y)).abs().amax() > 0.05


@pytest.mark.parametrize("offset", [0.0, 1e2, 1e4])
@pytest.mark.parametrize("spread", [1e-4, 1.0, 1e4])
def test_adain_is_the_papers_equation_over_all_reference_pixels(offset: float, spread: float) -> None:
    """Large means cost no digits but those that the features themselves have lost."""
    content, semantic = points()
    content = (content + offset) * spread
    refs = references(1.0, 3.0)
    stylizer = AdainConfig().build(
        dictionary=build_dictionary(refs, clusters=3), scene=scene_of(content, semantic)
    )
    assert stylizer.needs == Want.CONTENT
    f = content.double()
    pixels = torch.cat([refs[0].content, *[refs[1].content] * 3]).double()
    expected = pixels.std(0, correction=0) * (f - f.mean(0)) / f.std(0, correction=0) + pixels.mean(0)
    torch.testing.assert_close(
        stylizer(content, None).double(), expected, rtol=1e-5, atol=1e-4 + 1e-6 * offset
    )


@pytest.mark.parametrize("similarity", ["cosine", "dot"])
@pytest.mark.parametrize("temperature", [0.05, 0.4, 10.0])
def test_local_adain_is_the_papers_equations(similarity: str, temperature: float) -> None:
    content, semantic, scene, d = setting()
    stylizer = LocalAdainConfig(similarity=similarity, temperature=temperature).build(
        dictionary=d, scene=scene
    )
    assert stylizer.needs == Want.CONTENT | Want.SEMANTIC
    queries = semantic.double()
    keys = d.keys.double()
    regions = scene.keys.double()
    if similarity == "cosine":
        keys = unit(keys, share_mean(keys, d.share.double()))
        queries, regions = (unit(q, scene.semantic_mean.double()) for q in (queries, regions))
    # R = F_DINO F_DINO(I_s)^T, R^S = Softmax(R), M_w = R^S M, Sigma_w = R^S Sigma (Eq. 5, 6)
    r = torch.stack([torch.stack([(q * k).sum() for k in keys]) for q in queries])
    r_s = torch.softmax(r / (temperature * score_spread(regions, keys)), 1)
    sigma = d.covariance.double().diagonal(dim1=1, dim2=2).sqrt()
    m_w = r_s @ d.mean.double()
    sigma_w = r_s @ sigma
    mu_c = scene.mean.double()
    sigma_c = scene.covariance.double().diagonal().sqrt()
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


def test_other_encoders_references_are_refused() -> None:
    content, semantic = points()
    d = build_dictionary([Reference("a", torch.randn(9, 5), torch.randn(9, 4))])
    for config in (LocalAdainConfig(), region_adain()):
        with pytest.raises(DataError, match="5 content and 4 semantic channels"):
            config.build(dictionary=d, scene=scene_of(content, semantic))


BOTH = (region_adain, RegionOtConfig)
CONFIG = region_adain(whitening=0.0, recentred=0)
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
    here = plain_table(scene, own, temperature)
    there = plain_table(scene, d, temperature)
    f = content.double()
    expected = torch.zeros(600, 6, dtype=torch.float64)
    for k in range(len(scene.keys)):
        mean_c, mean_s = (t[k] @ x.mean.double() for t, x in ((here, own), (there, d)))
        if config is RegionOtConfig:
            cov_c, cov_s = (
                torch.einsum("t,tij->ij", t[k], x.covariance.double()) for t, x in ((here, own), (there, d))
            )
            a = monge(cov_c, cov_s, gain=8.0)
        else:
            sigma_c, sigma_s = (
                t[k] @ deviation(x.mean, x.covariance.diagonal(dim1=1, dim2=2)).double()
                for t, x in ((here, own), (there, d))
            )
            a = (sigma_s / sigma_c).diag()
        expected += share[:, k, None] * ((f - mean_c) @ a + mean_s)
    torch.testing.assert_close(stylizer(content, semantic).double(), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(stylizer.match(semantic).double(), share @ there, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("config", BOTH)
@pytest.mark.parametrize("regions", [1, 3, 9])
@pytest.mark.parametrize("temperature", [0.05, 0.4, 20.0])
@pytest.mark.parametrize("blend", [0.0, 0.3, 1.0])
def test_the_scenes_own_style_is_the_identity(
    config: Config, regions: int, temperature: float, blend: float
) -> None:
    content, semantic = points(600)
    content[:, 1] *= 1e-3
    content[:, 2] = 4.0
    scene = scene_of(content, semantic, regions)
    scene = scene._replace(contacts=torch.full_like(scene.contacts, 0.1))
    for smoothness in (0.0, 5.0):
        made = config(temperature=temperature, smoothness=smoothness).build(
            dictionary=own_style(scene, blend), scene=scene
        )
        out = made(content, semantic)
        assert float((out - content).abs().max() / content.abs().max()) < 1e-5


@pytest.mark.parametrize("config", BOTH)
def test_smoothness_makes_regions_alike_that_meet(config: Config) -> None:
    _, _, scene, d = setting(n=600)
    contacts = torch.zeros(3, 3)
    contacts[0, 1] = contacts[1, 0] = 0.1
    scene = scene._replace(contacts=contacts)
    tables = [
        config(smoothness=s).build(dictionary=d, scene=scene).get_buffer("table") for s in (0.0, 2.0, 1e6)
    ]
    apart = [float((table[0] - table[1]).abs().sum()) for table in tables]
    assert apart[0] > 0.1 and apart[0] > apart[1] > apart[2] and apart[2] < 1e-4
    torch.testing.assert_close(tables[2][2], tables[0][2], msg="region 2 meets none")
    pinned = d._replace(allowed=torch.tensor([[True, False], [True, True], [True, True]]))
    alone = [
        config(smoothness=s).build(dictionary=pinned, scene=scene).get_buffer("table")[0] for s in (0.0, 1e6)
    ]
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
    st.sampled_from(
        [AdainConfig(), LocalAdainConfig(), FORM, region_adain(), RegionOtConfig(), RegionToneConfig()]
    ),
)
def test_never_nan_for_degenerate_scenes_and_styles(
    n: int, regions: int, clusters: int, here: float, there: float, config: StylizerConfig
) -> None:
    content = torch.randn(n, 4) * here + 3
    semantic = torch.randn(n, 3) * here
    d = build_dictionary(
        [Reference("a", torch.randn(n, 4) * there, torch.randn(n, 3) * there)], clusters=clusters
    )
    scene = scene_of(content, semantic, regions)
    made = config.build(dictionary=d, scene=scene)
    for rows in (n, 1, 0):
        out = made(content[:rows], semantic[:rows])
        assert out.shape == (rows, 4) and bool(out.isfinite().all())
