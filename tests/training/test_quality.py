import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from tiny_world import World

from fprf.cli import main as cli
from fprf.cli.eval import EvalConfig
from fprf.cli.render import RenderVerbConfig
from fprf.cli.stylize import StylizeConfig
from fprf.errors import ConfigError, PluginError, UsageError
from fprf.plugins.samplers.config import ProposalConfig, SamplerConfig, UniformConfig
from fprf.training.loading import Trained
from fprf.training.quality import PRESETS, Name, QualityConfig, at_quality
from fprf.training.views import render_view


def picture(trained: Trained) -> torch.Tensor:
    return render_view(trained.model, trained.known.facts, trained.known.cameras, 0, trained.config.render).rgb


def test_presets_cost_more_and_spare_less_one_after_the_other() -> None:
    assert tuple(PRESETS) == get_args(Name)
    draft, standard, best = PRESETS.values()
    assert draft.samples <= standard.samples == 1 <= best.samples and draft.budget > standard.budget > best.budget > 0
    assert draft.resolution < standard.resolution == best.resolution == 1


def test_nothing_asked_is_the_run_itself(world: World) -> None:
    trained = world.load()
    same = at_quality(trained, QualityConfig())
    assert same.config == trained.config and same.model is trained.model


def test_standard_is_what_methods_are_made_for(world: World) -> None:
    trained = world.load()
    assert torch.equal(picture(at_quality(trained, QualityConfig(quality="standard"))), picture(trained))


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_sets_budget_and_samples(world: World, name: Name) -> None:
    preset, trained = PRESETS[name], at_quality(world.load(), QualityConfig(quality=name))
    old, new = world.config.sampler, trained.config.sampler
    assert isinstance(old, ProposalConfig) and isinstance(new, ProposalConfig)
    assert trained.config.render == replace(world.config.render, budget=preset.budget, resolution=preset.resolution)
    assert (new.samples, new.final) == ((round(16 * preset.samples),), round(8 * preset.samples))
    rays = trained.model.space.rays(torch.zeros(3, 3).double(), torch.eye(3).double())
    sampled = trained.model.sampler(rays, space=trained.model.space, step=None, generator=None)
    assert sampled.t.shape == (3, new.final + 1)


def test_what_is_given_goes_before_the_preset(world: World) -> None:
    asked = QualityConfig(quality="best", samples=1.0, budget=0.0, chunk=50, resolution=0.75)
    trained = at_quality(world.load(), asked)
    assert trained.config.sampler == world.config.sampler
    render = trained.config.render
    assert (render.budget, render.chunk, render.resolution) == (0.0, 50, 0.75)


def test_a_runs_own_budget_holds_where_no_quality_is_asked(world: World) -> None:
    trained = world.load()
    config = replace(trained.config, render=replace(trained.config.render, budget=0.125))
    assert at_quality(replace(trained, config=config), QualityConfig(samples=2.0)).config.render.budget == 0.125


def test_trained_parameters_are_kept_and_the_first_model_is_not_touched(world: World) -> None:
    trained = world.load()
    before = picture(trained)
    finer = at_quality(trained, QualityConfig(samples=3.0))
    own, new = trained.model.state_dict(), finer.model.state_dict()
    assert own.keys() == new.keys() and all(torch.equal(own[key], new[key]) for key in own)
    assert not any(p.requires_grad for p in finer.model.parameters())
    assert not torch.equal(picture(finer), before) and torch.equal(picture(trained), before)


def test_samples_scale_by_share_and_never_vanish() -> None:
    assert UniformConfig(samples=128).scaled(0.5) == UniformConfig(samples=64)
    assert UniformConfig(samples=3).scaled(1e-3).samples == 1
    assert ProposalConfig().scaled(2) == replace(ProposalConfig(), samples=(512, 256), final=96)
    least = ProposalConfig().scaled(1e-6)
    assert (least.samples, least.final) == ((2, 2), 1)


def test_a_sampler_that_does_not_scale(world: World) -> None:
    trained = world.load()
    config = replace(trained.config, sampler=SamplerConfig())
    with pytest.raises(PluginError, match=r"samples: SamplerConfig does not scale; leave --samples at 1"):
        at_quality(replace(trained, config=config), QualityConfig(quality="best"))
    assert at_quality(replace(trained, config=config), QualityConfig(quality="standard")).model is trained.model


def test_a_sampler_that_learns_for_its_number_of_samples(world: World) -> None:
    trained = world.load()
    config = replace(trained.config, sampler=ProposalConfig(samples=(16,), final=8, resolutions=(4,)))
    with pytest.raises(UsageError, match="has learnt for its own number of samples"):
        at_quality(replace(trained, config=config), QualityConfig(samples=2.0))


@pytest.mark.parametrize(
    ("field", "value"),
    [("samples", 0.0), ("budget", 0.6), ("budget", -0.1), ("chunk", 0), ("resolution", 0.0), ("resolution", 1.5)],
)
@pytest.mark.parametrize("kind", [QualityConfig, EvalConfig, RenderVerbConfig, StylizeConfig])
def test_ranges_are_checked_wherever_it_is_part(kind: type[QualityConfig], field: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{field}: "):
        kind(**{field: value})


def test_eval_takes_it(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import json

    shutil.copytree(world.run, tmp_path / "run")
    kept = {}
    for name in (None, *PRESETS):
        args = ["eval", str(tmp_path / "run"), "--no-images", *([] if name is None else ["--quality", name])]
        assert cli.main(args) == 0
        metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
        assert metrics["quality"] == name
        kept[name] = metrics["psnr"], metrics["kept_samples_share"]
    assert kept[None] == kept["standard"] and len(set(kept.values())) == 3
    assert cli.main(["eval", str(tmp_path / "run"), "--quality", "great"]) == 2
    assert "--quality great: it takes draft or standard or best" in capsys.readouterr().err


def test_render_and_stylize_take_it(world: World, tmp_path: Path) -> None:
    import cv2

    shutil.copytree(world.run, tmp_path / "run")
    run, split = str(tmp_path / "run"), ["--split", "test"]
    style = ["--references", str(world.references[0]), "--no-matches"]
    pictures = {}
    for name in PRESETS:
        quality = ["--quality", name]
        assert cli.main(["render", run, "--path", "dataset", *split, "--output", str(tmp_path / f"r-{name}"), *quality]) == 0
        assert cli.main(["stylize", run, *style, *split, "--output", str(tmp_path / f"s-{name}"), *quality]) == 0
        pictures[name] = [cv2.imread(str(tmp_path / f"{kind}-{name}" / "0000.png")) for kind in "rs"]
    for first, second in (("draft", "standard"), ("standard", "best")):
        for a, b in zip(pictures[first], pictures[second], strict=True):
            assert a.shape == b.shape and (a != b).any()


def test_a_reduced_view_is_the_small_oneenlarged(world: World) -> None:
    trained = world.load()
    known, render = trained.known, trained.config.render
    whole, half = (render_view(trained.model, known.facts, known.cameras, 2, replace(render, resolution=r)) for r in (1.0, 0.5))
    small = render_view(trained.model, known.facts, known.cameras.scaled(2), 2, render)
    assert half.rgb.shape == whole.rgb.shape and half.depth.shape == whole.depth.shape == half.opacity.shape
    assert float(half.rgb.min()) >= 0 and float(half.rgb.max()) <= 1
    assert {*half.depth.flatten().tolist()} == {*small.depth.flatten().tolist()}, "no depth that nobody measured"
    blocks = half.opacity.view(12, 2, 16, 2).mean((1, 3))
    assert torch.allclose(blocks[1:-1, 1:-1], small.opacity[1:-1, 1:-1], atol=0.05)
    assert float((half.rgb - whole.rgb).abs().mean()) < 0.05 and not torch.equal(half.rgb, whole.rgb)


def test_infinite_depths_are_enlarged_too(world: World) -> None:
    from fprf.rendering.renderer import enlarged
    from fprf.types import View

    depth = torch.tensor([[1.0, torch.inf]])
    found = enlarged(View(torch.rand(1, 2, 3), depth, torch.ones(1, 2), 1.0), [4, 2])
    assert found.depth.tolist() == [[1.0, 1.0, torch.inf, torch.inf]] * 2
