import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.cli import main as cli
from fprf.errors import PluginError, UsageError
from fprf.plugins.samplers.config import ProposalConfig, SamplerConfig
from fprf.training.loading import Trained
from fprf.training.quality import PRESETS, QualityConfig, at_quality
from fprf.training.views import render_view


def picture(trained: Trained) -> torch.Tensor:
    return render_view(trained.model, trained.known.facts, trained.known.cameras, 0, trained.config.render).rgb


def test_trained_parameters_are_kept_and_the_first_model_is_not_touched(world: World) -> None:
    trained = world.load()
    before = picture(trained)
    finer = at_quality(trained, QualityConfig(samples=3.0))
    own, new = trained.model.state_dict(), finer.model.state_dict()
    assert own.keys() == new.keys() and all(torch.equal(own[key], new[key]) for key in own)
    assert not any(p.requires_grad for p in finer.model.parameters())
    assert not torch.equal(picture(finer), before) and torch.equal(picture(trained), before)


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
