"""Global and local AdaIN against Eq. 5 and 6 of the paper, transcribed in float64: on features, and by the verb."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import pytest
import torch
from safetensors.torch import load_file
from style_cases import points, references, region_adain, scene_of, setting
from tiny_world import World
from torch import Tensor

from fprf.cli import main as cli
from fprf.datamanagers.basis import Basis, fit_basis
from fprf.errors import DataError
from fprf.interfaces import Stylizer
from fprf.plugins.stylizers.adain import AdainStylizer
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig
from fprf.style.dictionary import Reference, build_dictionary
from fprf.style.look import Restyle
from fprf.style.matching import score_spread, share_mean, unit
from fprf.style.scene_style import SceneStyle, own_style, scene_style
from fprf.training.loading import load_style
from fprf.training.views import render_view
from fprf.types import Want

FORM = LocalAdainConfig(similarity="dot", centred=False, relative=False, temperature=1.0)
KNOBS = {"similarity": "dot", "centred": "False", "relative": "False", "temperature": "1"}
FLAGS = ["--stylizer", "local-adain", "--blend", "0", *(w for k, v in KNOBS.items() for w in (f"--stylizer.{k}", v))]
U = 2.0**-24


def attention(f: Tensor, keys: Tensor) -> Tensor:
    """R = F_DINO F_DINO(I_s)^T (Eq. 5), R^S = Softmax(R)."""
    return torch.softmax(f @ keys.T, 1)


def local_adain(content: Tensor, r_s: Tensor, m: Tensor, sigma: Tensor, mu_c: Tensor, sigma_c: Tensor) -> Tensor:
    """M_w = R^S M, Sigma_w = R^S Sigma (Eq. 6); AdaIN to Sigma_w (F_VGG - mu_c) / sigma_c + M_w."""
    m_w, sigma_w = r_s @ m, r_s @ sigma
    return sigma_w * (content - mu_c) / sigma_c + m_w


class Case(NamedTuple):
    """Pixels of a scene and of three references of one cluster each; semantics as an encoder gives them, far from 0."""

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
    scene = scene_style(given.content, basis.project(given.semantic), torch.ones(len(given.content)), None, 3, 0)
    return config.build(dictionary=dictionary, scene=scene), [given.styles[int(name)] for name in dictionary.names]


def logit_error(f: Tensor, keys: Tensor) -> float:
    """Bound of what rounding changes a score by: projected features (2 (D + 2) u), differences (2 u), sums of D products."""
    return float((4 * f.shape[1] + 12) * U * f.norm(dim=1).amax() * keys.norm(dim=1).amax())


def test_with_a_basis_of_full_rank_it_is_the_papers_equations_on_the_encoders_own_features() -> None:
    given = case()
    basis = fit_basis(given.semantic, 10)
    stylizer, styles = built(given, basis)
    found, match = stylizer(given.content, basis.project(given.semantic)), stylizer.match(basis.project(given.semantic))
    content, f = given.content.double(), given.semantic.double()
    keys = torch.stack([r.semantic.double().mean(0) for r in styles])
    m, sigma = (torch.stack([each(r.content.double()) for r in styles]) for each in (mean, deviation))
    r_s = attention(f, keys)
    exact = local_adain(content, r_s, m, sigma, mean(content), deviation(content))
    relative = float(torch.tensor(2 * logit_error(f, keys)).expm1())
    assert ((match.double() - r_s).abs() <= relative * r_s + U).all()
    size = r_s @ m.abs() + (r_s @ sigma) * ((content - mean(content)) / deviation(content)).abs()
    assert ((found.double() - exact).abs() <= (relative + 16 * U) * size + U * m.abs().amax()).all()
    assert 0.1 < float(r_s.amax(1).mean()) < 0.99 and relative < 1e-3, "scores decide, and neither all nor nothing"


@pytest.mark.parametrize("similarity", ["cosine", "dot"])
def test_the_encoders_zero_plays_no_part_in_centred_matches(similarity: str) -> None:
    given = case()
    basis = fit_basis(given.semantic, 10)
    config = LocalAdainConfig(similarity=similarity)  # type: ignore[arg-type]
    y = basis.project(given.semantic)
    one, other = (built(given, basis, config, origin=known)[0] for known in (True, False))
    assert torch.equal(one.match(y), other.match(y)) and torch.equal(one(given.content, y), other(given.content, y))
    assert isinstance(one, AdainStylizer) and one.origin is None


class Transcribed(Stylizer):
    """Eq. 5 and 6 in float64 on a trained run: the field's features lifted to the encoder's channels, codes from the file."""

    def __init__(self, folder: Path, scene: SceneStyle, basis: Basis) -> None:
        super().__init__()
        codes = {name: table.double() for name, table in load_file(folder / "dictionary.safetensors").items()}
        self.basis, self.keys = basis, basis.lift(codes["keys"])
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
        words = ["--references", *map(str, world.references), "--clusters", "3", "--views", "0002", "--device", "cpu"]
        assert cli.main(["stylize", str(world.run), *words, "--output", str(tmp_path / name), *flags]) == 0
        found = cv2.imread(str(tmp_path / name / "0002.png"))
        pictures.append(torch.from_numpy(found[..., ::-1].copy()).double())
    trained = world.load()
    scene, basis = load_style(trained.run)
    assert basis is not None
    look, known = Restyle(Transcribed(tmp_path / "paper", scene, basis)), trained.known
    view = known.names.index("0002")
    exact = render_view(trained.model, known.facts, known.cameras, view, trained.config.render, look).rgb.double() * 255
    assert (pictures[0] - exact).abs().amax() <= 0.5 + 1e-2
    assert (pictures[1] - exact).abs().amax() > 3


def mean(x: Tensor) -> Tensor:
    return x.mean(0)


def deviation(x: Tensor) -> Tensor:
    return x.std(0, correction=0)


@pytest.mark.parametrize("knob", [{"centred": True}, {"relative": True}, {"similarity": "cosine"}, {"temperature": 100.0}])
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


def test_other_encoders_references_are_refused() -> None:
    content, semantic = points()
    d = build_dictionary([Reference("a", torch.randn(9, 5), torch.randn(9, 4))])
    for config in (LocalAdainConfig(), region_adain()):
        with pytest.raises(DataError, match="5 content and 4 semantic channels"):
            config.build(dictionary=d, scene=scene_of(content, semantic))
