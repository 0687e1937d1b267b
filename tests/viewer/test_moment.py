import shutil
from pathlib import Path

import pytest
import torch
from tiny_world import World

from fprf.errors import CheckpointError
from fprf.style.scene import SceneStyle
from fprf.training.loading import load_run, load_style
from fprf.training.views import render_view
from fprf.viewer.moment import begun, encoders_now, filled, likest


@pytest.fixture
def fresh(world: World, tmp_path: Path) -> Path:
    """A run as it is when training begins: no checkpoint, no style."""
    run = tmp_path / "run"
    run.mkdir()
    for name in ("config.json", "scene.json", "basis.safetensors"):
        shutil.copy(world.run / name, run / name)
    return run


def test_a_run_that_has_just_begun_renders_and_with_its_parameters_is_the_run(world: World, fresh: Path) -> None:
    trained, last = begun(fresh, "cpu"), world.load()
    assert not trained.model.training and not any(p.requires_grad for p in trained.model.parameters())
    facts, cameras, config = trained.known.facts, trained.known.cameras, trained.config.render
    start = render_view(trained.model, facts, cameras, 0, config).rgb
    assert filled(trained, last.model.state_dict()) is trained
    end = render_view(trained.model, facts, cameras, 0, config).rgb
    assert torch.equal(end, render_view(last.model, facts, cameras, 0, config).rgb) and not torch.equal(start, end)


def test_parameters_of_another_config_are_refused(fresh: Path) -> None:
    with pytest.raises(CheckpointError, match="not those of its config"):
        filled(begun(fresh, "cpu"), {"x": torch.zeros(3)})


def test_no_folder_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no config\.json"):
        begun(tmp_path, "cpu")


def test_the_style_of_a_moment_is_that_which_training_measures(world: World, fresh: Path) -> None:
    trained = filled(begun(fresh, "cpu"), world.load().model.state_dict())
    first = encoders_now(trained, None)
    wanted, _ = load_style(load_run(world.run, "cpu").run)  # the tiny world has fewer rays than a moment takes
    for found, each in zip(first.scene, wanted, strict=True):
        assert torch.allclose(found, each, atol=1e-5)
    again = encoders_now(trained, first)
    assert again.content is first.content and again.semantic is first.semantic and again.basis is first.basis


def test_regions_are_known_again_whatever_their_order() -> None:
    generator = torch.Generator().manual_seed(0)
    keys = torch.randn(6, 8, generator=generator)
    middle = torch.randn(8, generator=generator)

    def style(keys: torch.Tensor) -> SceneStyle:
        k, c = len(keys), 3
        return SceneStyle(
            torch.zeros(c),
            torch.eye(c),
            keys,
            torch.zeros(k, c),
            torch.zeros(k, c, c),
            torch.full((k,), 1 / k),
            middle,
            torch.zeros(k, k),
        )

    order = torch.randperm(6, generator=generator)
    moved = style(keys[order] + 0.01 * torch.randn(6, 8, generator=generator))
    assert torch.equal(order[likest(style(keys), moved)], torch.arange(6))
    assert likest(style(keys), style(keys[:4])).max() < 4
    assert torch.equal(likest(style(keys[:, :0]), style(keys[:, :0])), torch.zeros(6, dtype=torch.int64))
