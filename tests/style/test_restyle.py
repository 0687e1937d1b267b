"""Photographs to styles of a run: every field changes what is rendered, mistakes are told; maps of
matches.
"""

from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from style_cases import region_adain
from tiny_world import World

from fprf.errors import ConfigError
from fprf.light.config import SunConfig
from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, StylizerConfig
from fprf.rendering.cameras import pixel_grid
from fprf.style.config import NO_MASK, StyleConfig
from fprf.style.dictionary import Encoders
from fprf.style.files import StyleFile, write_style
from fprf.style.match_maps import MatchMap, match_map, summarize
from fprf.style.restyle import Codes, Styled, apply_style
from fprf.training.field_scene import Trained
from fprf.training.views import paint_pixels, render_view

SECOND: dict[str, object] = {
    "weights": (5.0, 1.0),
    "clusters": 1,
    "blend": 0.9,
    "strength": 0.5,
    "luminance": 1.0,
    "bold": 1.0,
    "pin": ("0=1",),
    "forbid": ("0=0",),
    "keep": ("0",),
    "region_strength": ("0=0.5",),
    "keep_below": 0.99,
    "stylizer": region_adain(),
}
"""Those of `references`, `masks`, `between` and `at` need files: see below."""


class Bench:
    """A run in memory, and pictures of its first view."""

    def __init__(self, world: World) -> None:
        self.trained: Trained = world.load()
        self.encoders: Encoders = self.trained.encoders()
        self.base = StyleConfig(references=world.references, clusters=3)
        self.plain = self.show(None)
        self.first = self.show(self.base)

    def show(self, style: StyleConfig | None) -> torch.Tensor:
        known = self.trained.known
        config = self.trained.config.render
        look = None if style is None else apply_style(self.trained, StyleFile(style), self.encoders).restyle
        return render_view(self.trained.model, known.facts, known.cameras, 0, config, look).rgb


@pytest.fixture(scope="module")
def bench(_world: World) -> Bench:
    return Bench(_world)


def test_every_field_has_a_second_value() -> None:
    # Lights are for Gaussians: tests/splats/test_relighting.py.
    lights = {field.name for field in fields(SunConfig)}
    others = {*SECOND, *lights, "references", "masks", "between", "at"}
    assert {field.name for field in fields(StyleConfig)} == others


@pytest.mark.parametrize("name", SECOND)
def test_a_second_value_changes_the_picture(bench: Bench, name: str) -> None:
    second = bench.show(replace(bench.base, **{name: SECOND[name]}))  # type: ignore[arg-type]
    assert bool(second.isfinite().all()) and float((second - bench.first).abs().max()) > 1e-4


def test_references_and_masks_change_the_picture(bench: Bench, tmp_path: Path) -> None:
    mask = np.zeros((40, 56), np.uint8)
    mask[20:] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert not torch.allclose(
        bench.show(replace(bench.base, references=bench.base.references[:1])), bench.first, atol=1e-4
    )
    masked = bench.show(replace(bench.base, masks=(tmp_path / "mask.png", NO_MASK)))
    assert not torch.allclose(masked, bench.first, atol=1e-4)
    assert torch.equal(bench.show(replace(bench.base, masks=(NO_MASK, NO_MASK))), bench.first)


def test_between_two_styles(bench: Bench, tmp_path: Path) -> None:
    other = replace(bench.base, references=bench.base.references[:1], stylizer=AdainConfig(), luminance=0.5)
    write_style(tmp_path / "other.json", StyleFile(other))
    mixes = [
        bench.show(replace(bench.base, between=tmp_path / "other.json", at=at)) for at in (0.0, 0.3, 0.7, 1.0)
    ]
    end = bench.show(other)
    assert torch.equal(mixes[0], bench.first) and torch.equal(mixes[3], end)
    away = [float((mix - bench.first).abs().mean()) for mix in mixes]
    assert away == sorted(away) and away[1] > 0
    assert float((mixes[2] - end).abs().mean()) < float((mixes[1] - end).abs().mean())


def test_styles_that_lead_back_to_themselves_are_refused(bench: Bench, tmp_path: Path) -> None:
    a = tmp_path / "a.json"
    b = tmp_path / "b.json"
    b.write_text("{}")
    for path, towards in ((a, b), (b, a)):
        write_style(path, StyleFile(replace(bench.base, between=towards)))
    with pytest.raises(ConfigError, match=r"a\.json: lies between styles that lead back to it"):
        bench.show(replace(bench.base, between=a))


def test_the_order_of_references_does_not_matter_to_wishes(bench: Bench) -> None:
    a, b = bench.base.references
    one = replace(bench.base, pin=("0=snow.png",), forbid=("1=0",), weights=(2.0, 1.0))
    two = replace(bench.base, references=(b, a), pin=("0=0",), forbid=("1=dusk",), weights=(1.0, 2.0))
    assert torch.equal(bench.show(one), bench.show(two))


def styled_by(
    world: World, stylizer: StylizerConfig | None = None, **wishes: object
) -> tuple[Trained, Styled]:
    trained = world.load()
    style = StyleConfig(references=world.references, clusters=3, stylizer=stylizer or RegionOtConfig())
    return trained, apply_style(trained, StyleFile(replace(style, **wishes)))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "stylizer", [AdainConfig(), LocalAdainConfig(), RegionOtConfig()], ids=lambda s: type(s).__name__
)
def test_what_is_taken_is_the_stylizers_match(world: World, stylizer: StylizerConfig) -> None:
    trained, styled = styled_by(world, stylizer)
    found = match_map(trained, styled, 0)
    expected, _ = trained.paint(trained.cameras, 0, pixel_grid(trained.cameras, 0), styled.restyle.match)
    assert torch.allclose(found.taken.flatten(0, 1), expected, atol=1e-5) and float(found.kept.max()) < 1e-4
    picture = render_view(trained.model, trained.known.facts, trained.known.cameras, 0, trained.config.render)
    assert torch.allclose(found.opacity, picture.opacity)
    assert float(found.score.abs().max()) <= 1 and bool(found.score.isfinite().all())


def test_kept_regions_take_nothing(world: World) -> None:
    trained, styled = styled_by(world, keep=("0",))
    found = match_map(trained, styled, 0)
    assert torch.allclose(found.kept, found.region[..., 0], atol=1e-4) and float(found.kept.max()) > 0.01
    assert torch.allclose(found.taken.sum(-1) + found.kept, torch.ones(()), atol=1e-4)
    summary = summarize(found, styled.codes)
    assert summary["kept_share"] == pytest.approx(
        float((found.kept * found.opacity).sum() / found.opacity.sum()), abs=1e-5
    )


def test_the_score_is_the_mean_cosine_with_what_is_taken(world: World) -> None:
    trained, styled = styled_by(world, keep=("0",))
    found = match_map(trained, styled, 0)
    centre = styled.scene_style.semantic_mean.double()
    keys = styled.dictionary.keys.double()
    there = torch.nn.functional.normalize(keys - centre, dim=1)

    def of_points(semantic: torch.Tensor, points: torch.Tensor | None) -> torch.Tensor:
        """Each code's share, and its share times its cosine, in float64."""
        cosine = torch.nn.functional.normalize(semantic.double() - centre, dim=1) @ there.T
        taken = styled.restyle.match(semantic).double()
        return torch.cat([taken, taken * cosine], 1).float()

    cameras = trained.known.cameras
    values, _ = paint_pixels(
        trained.model, cameras, 0, pixel_grid(cameras, 0), trained.config.render, of_points
    )
    taken, weighted = values.double().chunk(2, dim=1)
    expected = (weighted.sum(1) / taken.sum(1).clamp_min(1e-10)).view(24, 32)
    some = found.kept < 0.99
    assert int(some.sum()) > 100 and torch.allclose(found.score.double()[some], expected[some], atol=1e-4)


def made_up() -> tuple[MatchMap, Codes]:
    """Two by two pixels: sure of code 0, torn between codes 1 and 2, kept, and empty."""
    taken = torch.tensor([[[1.0, 0, 0], [0, 0.5, 0.5]], [[0, 0, 0], [0, 0, 0]]])
    region = torch.tensor([[[1.0, 0], [0, 1]], [[0.0, 1], [0, 0]]])
    score, sure = torch.tensor([[[0.9, 0.2], [0.0, 0.0]], [[0.8, 0.4], [0.7, 0.0]]])
    found = MatchMap(taken, score, region, sure, torch.tensor([[1.0, 1], [1, 0]]))
    return found, Codes(torch.tensor([0, 1, 1]), ("a.jpg", "b.jpg"), torch.eye(3))


def test_summaries_count_what_is_there() -> None:
    summary = summarize(*made_up())
    assert summary["references"] == [{"name": "a.jpg", "share": 0.5}, {"name": "b.jpg", "share": 0.5}]
    assert summary["kept_share"] == pytest.approx(1 / 3) and summary["score"] == pytest.approx(0.55)
    assert summary["entropy_bits"] == pytest.approx(0.5) and summary["confidence"] == pytest.approx(0.6)
    assert summary["codes"][0] == {"reference": "a.jpg", "cluster": 0, "share": pytest.approx(1 / 3)}
    assert {(c["reference"], c["cluster"]) for c in summary["codes"][1:]} == {("b.jpg", 0), ("b.jpg", 1)}
    assert summary["regions"] == [
        {"region": 0, "share": pytest.approx(1 / 3)},
        {"region": 1, "share": pytest.approx(2 / 3)},
    ]
