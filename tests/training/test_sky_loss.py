"""Rays into the sky are empty before it."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pretend_cuda import CUDA, pretend_cuda
from tiny_world import World, trained_for

from fprf.training.losses import SHELL, emptiness
from fprf.types import Batch


@pytest.mark.parametrize(("shell", "wanted"), [(4.0, (0.3**2 + 1.0**2) / 2), (math.inf, (0.9**2 + 1.0**2) / 2), (0.5, 0.0)])
def test_what_sky_rays_meet_before_the_shell(shell: float, wanted: float) -> None:
    t = torch.tensor([[1.0, 3.0, 6.0]]).repeat(3, 1)
    weights = torch.tensor([[0.3, 0.6], [0.5, 0.5], [1.0, 0.0]], requires_grad=True)
    found = emptiness(t, weights, torch.tensor([True, False, True]), within=shell)
    assert found is not None and found.item() == pytest.approx(wanted)
    found.backward()
    assert weights.grad is not None and not weights.grad[1].any()


def test_without_sky_there_is_no_term() -> None:
    assert emptiness(torch.rand(2, 4), torch.rand(2, 3), torch.tensor([False, False]), within=SHELL) is None


@pytest.mark.parametrize("sky", [[True, False, True], [False] * 3])
def test_a_device_gives_the_same_without_waiting(sky: list[bool]) -> None:
    """But for 0 where there is none."""
    t, weights = torch.tensor([[1.0, 3.0, 6.0]]).repeat(3, 1), torch.tensor([[0.3, 0.6], [0.5, 0.5], [1.0, 0.0]])
    expected = emptiness(t, weights, torch.tensor(sky), within=SHELL)
    with pretend_cuda() as seen:
        given = t.to(CUDA), weights.to(CUDA), torch.tensor(sky).to(CUDA)
        found = emptiness(*given, within=SHELL)
        assert found is not None and not seen.syncs
        assert found.item() == pytest.approx(0.0 if expected is None else expected.item())


def test_the_sky_is_cleared(world: World, tmp_path: Path) -> None:
    """Rays of the upper third are said to be sky: they are emptied where that counts; at weight 0 nothing is computed."""

    def mark(step: int, batch: Batch) -> Batch:
        return batch._replace(sky=batch.pixel[:, 1] < 8)

    last = {}
    for weight in (1.0, 1e-9, 0.0):
        events = []
        config = replace(world.config, steps=40, loss=replace(world.config.loss, sky=weight))
        trained_for(world, tmp_path / str(weight), config, change=mark, report=events.append)
        last[weight] = events[-1].losses
    assert last[1.0]["sky"] < 0.8 * last[1e-9]["sky"]
    assert "sky" not in last[0.0]
