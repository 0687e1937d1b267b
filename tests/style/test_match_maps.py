"""Match maps against the attention of single points, and their files."""

from dataclasses import replace

import pytest
import torch
from tiny_world import World

from fprf.plugins.stylizers.config import AdainConfig, LocalAdainConfig, RegionOtConfig, StylizerConfig
from fprf.rendering.cameras import pixel_grid
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile
from fprf.style.match_maps import MatchMap, match_map, summarize
from fprf.style.restyle import Codes, Styled, apply_style
from fprf.training.loading import Trained
from fprf.training.views import paint_pixels, render_view


def styled_by(world: World, stylizer: StylizerConfig | None = None, **wishes: object) -> tuple[Trained, Styled]:
    trained = world.load()
    style = StyleConfig(references=world.references, clusters=3, stylizer=stylizer or RegionOtConfig())
    return trained, apply_style(trained, StyleFile(replace(style, **wishes)))  # type: ignore[arg-type]


@pytest.mark.parametrize("stylizer", [AdainConfig(), LocalAdainConfig(), RegionOtConfig()], ids=lambda s: type(s).__name__)
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
    assert summary["kept_share"] == pytest.approx(float((found.kept * found.opacity).sum() / found.opacity.sum()), abs=1e-5)


def test_the_score_is_the_mean_cosine_with_what_is_taken(world: World) -> None:
    trained, styled = styled_by(world, keep=("0",))
    found = match_map(trained, styled, 0)
    centre, keys = styled.scene_style.semantic_mean.double(), styled.dictionary.keys.double()
    there = torch.nn.functional.normalize(keys - centre, dim=1)

    def of_points(semantic: torch.Tensor, points: torch.Tensor | None) -> torch.Tensor:
        """Each code's share, and its share times its cosine, in float64."""
        cosine = torch.nn.functional.normalize(semantic.double() - centre, dim=1) @ there.T
        taken = styled.restyle.match(semantic).double()
        return torch.cat([taken, taken * cosine], 1).float()

    cameras = trained.known.cameras
    values, _ = paint_pixels(trained.model, cameras, 0, pixel_grid(cameras, 0), trained.config.render, of_points)
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
    assert summary["regions"] == [{"region": 0, "share": pytest.approx(1 / 3)}, {"region": 1, "share": pytest.approx(2 / 3)}]
