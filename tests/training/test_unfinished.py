"""Runs that training has only begun, with parameters that come from it."""

import shutil
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.errors import CheckpointError
from fprf.training.loading import load_run, load_style
from fprf.training.unfinished import UnfinishedFields


@pytest.fixture
def fresh(world: World, tmp_path: Path) -> Path:
    """A run as it is when training begins: no checkpoint, no style."""
    run = tmp_path / "run"
    run.mkdir()
    for name in ("config.json", "scene.json", "basis.safetensors"):
        shutil.copy(world.run / name, run / name)
    return run


def test_a_run_that_has_just_begun_renders_and_with_its_parameters_is_the_run(world: World, fresh: Path) -> None:
    unfinished, last = UnfinishedFields(fresh, "cpu"), world.load()
    trained = unfinished.trained
    assert not trained.model.training and not any(p.requires_grad for p in trained.model.parameters())
    start = trained.render(trained.cameras, 0).rgb
    assert unfinished.scene(last.model.state_dict()) is trained
    end = trained.render(trained.cameras, 0).rgb
    assert torch.equal(end, last.render(last.cameras, 0).rgb) and not torch.equal(start, end)


def test_parameters_of_another_config_are_refused(fresh: Path) -> None:
    with pytest.raises(CheckpointError):
        UnfinishedFields(fresh, "cpu").scene({"x": torch.zeros(3)})


def test_the_style_of_a_moment_is_that_which_training_measures(world: World, fresh: Path) -> None:
    unfinished = UnfinishedFields(fresh, "cpu")
    unfinished.scene(world.load().model.state_dict())
    first = unfinished.encoders(None)
    wanted, _ = load_style(load_run(world.run, "cpu").run)  # the tiny world has fewer rays than a moment takes
    for found, each in zip(first.scene, wanted, strict=True):
        assert torch.allclose(found, each, atol=1e-5)
    again = unfinished.encoders(first)
    assert again.content is first.content and again.semantic is first.semantic and again.basis is first.basis
