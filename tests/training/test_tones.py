"""Factors of views: free of the scene, found again, the same in every block."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from block_world import BlockWorld, small, tensors_of
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_world import World, trained_for

from fprf.cli.train import train_scene
from fprf.training.camera_optimizers import Tones, relative
from fprf.training.loading import load_run
from fprf.training.views import render_view
from fprf.types import Batch


@settings(deadline=None)
@given(st.integers(1, 6), st.integers(0, 5), st.integers(0, 2**31 - 1))
def test_what_the_training_views_share_belongs_to_the_scene(count: int, held: int, seed: int) -> None:
    tones = Tones(torch.zeros(count + held), tuple(range(count, count + held)))
    draw = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        tones.gain.copy_(torch.randn(count + held, 3, generator=draw))
    factor = tones(torch.arange(count + held))
    torch.testing.assert_close(factor[:count].log().mean(0), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(factor[count:], torch.ones(held, 3))
    with torch.no_grad():
        tones.gain.add_(torch.tensor([0.3, -0.2, 1.0]))
    torch.testing.assert_close(tones(torch.arange(count + held)), factor, atol=1e-5, rtol=1e-4)


def test_known_exposures_speak_for_views_that_are_held_out() -> None:
    exposure = torch.tensor([1.0, 2.0, 4.0, 2.0])
    log = relative(exposure, 4)
    assert sum(log) == pytest.approx(0) and log[2] - log[0] == pytest.approx(torch.tensor(4.0).log().item())
    tones = Tones(torch.tensor(log), (3,))
    assert tones(torch.tensor([3]))[0].tolist() == pytest.approx([1.0] * 3)
    assert (tones(torch.tensor([2])) / tones(torch.tensor([0])))[0].tolist() == pytest.approx([4 ** (1 / 2.2)] * 3)
    assert relative(None, 3) == (0.0, 0.0, 0.0)


def test_views_that_were_taken_darker_are_found(world: World, tmp_path: Path) -> None:
    """Half of the views at 70 %: their factors fall, the others' rise, and the loss with them is lower than without."""
    dark = torch.tensor([view % 2 == 0 for view in range(10)])

    def dim(step: int, batch: Batch) -> Batch:
        return batch._replace(rgb=torch.where(dark[batch.view][:, None], 0.7 * batch.rgb, batch.rgb))

    steps = 40
    config = replace(world.config, tones=True, steps=steps)
    facts = replace(
        world.prepared.facts, exposure=(0.0,) * 10, held=tuple(set(range(10)) - set(world.prepared.scene.train.tolist()))
    )
    changed = replace(world, prepared=world.prepared._replace(facts=facts))
    losses: dict[bool, float] = {}
    for own, name in ((changed, "with"), (world, "without")):
        events = []
        run = trained_for(own, tmp_path / name, replace(config, tones=own is changed), change=dim, report=events.append)
        losses[own is changed] = events[-1].losses["rgb"]
    from tiny_world import parameters

    gain = parameters(trained_for(changed, tmp_path / "with", config, change=dim), steps)["model.tones.gain"].mean(1)
    train = torch.zeros(10, dtype=torch.bool)
    train[world.prepared.scene.train] = True
    assert float(gain[train & dark].mean()) < float(gain[train & ~dark].mean()) - 0.1
    assert losses[True] < losses[False]
    assert run.root.is_dir()


def test_all_blocks_mean_the_same_by_a_view(block_world: BlockWorld, tmp_path: Path) -> None:
    config = replace(small(block_world.config.data, tmp_path / "run"), tones=True)
    train_scene(config, "fprf-lite", quiet=True)
    root = tmp_path / "run"
    first = tensors_of(root, "surroundings")["tones.gain"]
    assert float(first.abs().max()) > 0
    for name in ("00", "01", "02"):
        assert torch.equal(tensors_of(root, name)["tones.gain"], first)
    trained = load_run(root, "cpu")
    tones = trained.model.tones
    assert tones is not None and torch.equal(tones.gain, first)
    view = (trained.model, trained.known.facts, trained.known.cameras, 1, config.render)
    plain, double = render_view(*view).rgb, render_view(*view, factor=torch.tensor([0.5, 1.0, 1.0])).rgb
    torch.testing.assert_close(double, plain * torch.tensor([0.5, 1.0, 1.0]))
