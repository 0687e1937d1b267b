"""The training loop: resuming to the bit, faults of numbers, checkpoints, signals and the schedule."""

import math
import os
import signal
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from tiny_world import Altered, Change, World, events, parameters, same, spoilt, stopping, taught, trained_for
from torch import nn

from fprf.config import TrainConfig
from fprf.errors import CheckpointError, NumericsError
from fprf.ops import backend, triplane
from fprf.progress import Report
from fprf.training import checkpoint
from fprf.training.field_learner import CLEAR_EVERY, clear_denormals
from fprf.training.model import build_model
from fprf.training.run import Run
from fprf.types import Batch

NAN = float("nan")
INF = float("inf")


def stopped(world: World, folder: Path, config: TrainConfig, change: Change) -> Run:
    """Train until it is interrupted."""
    with pytest.raises(KeyboardInterrupt):
        trained_for(world, folder, config, change=change)
    return Run(folder)


def test_a_resumed_run_is_bitwise_the_one_that_never_stopped(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=12)
    straight = trained_for(world, tmp_path / "straight", config)
    folder = tmp_path / "stopped"
    assert checkpoint.steps(stopped(world, folder, config, stopping(6)).checkpoints) == [6], (
        "an interrupt saves first"
    )
    resumed = trained_for(world, folder, config)
    assert checkpoint.steps(resumed.checkpoints) == [6, 12]
    assert same(parameters(straight, 12), parameters(resumed, 12))
    assert not same(parameters(resumed, 6), parameters(resumed, 12))


def test_a_damaged_checkpoint_costs_its_steps_alone_and_is_named(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=8)
    folder = tmp_path / "run"
    stopped(world, folder, config, stopping(4))
    run = trained_for(world, folder, config)
    whole = parameters(run, 8)
    path = run.checkpoints / "step-0000008" / "model.safetensors"
    path.write_bytes(path.read_bytes()[:200])
    trained_for(world, folder, config)
    assert same(whole, parameters(run, 8))
    (event,) = events(run, "damaged")
    assert "step-0000008/model.safetensors" in event["damaged"]
    for step in checkpoint.steps(run.checkpoints):
        (run.checkpoints / f"step-{step:07d}" / "optimizer.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError, match="no intact checkpoint"):
        trained_for(world, folder, config)


def test_a_finished_run_stays_as_it_is(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=2)
    times = []
    reports = list[Report]()
    for report in (lambda event: None, reports.append):
        run = trained_for(world, tmp_path / "run", config, report=report)
        times.append({p: p.stat().st_mtime_ns for p in run.checkpoints.rglob("*")})
    assert times[0] == times[1] and not reports


def test_minutes_end_a_run_too(world: World, tmp_path: Path) -> None:
    reports: list[Report] = []
    config = replace(world.config, steps=10**6, minutes=0.4 / 60)
    run = trained_for(world, tmp_path / "run", config, report=reports.append)
    (step,) = checkpoint.steps(run.checkpoints)
    assert 1 <= step < 10**6 and reports[-1].share == 1 and reports[-1].seconds >= 0.4
    assert checkpoint.load(run.checkpoints, step).seconds == reports[-1].seconds
    trained_for(world, tmp_path / "run", config)
    assert checkpoint.steps(run.checkpoints) == [step], "the time that a run had counts when it goes on"


def test_checkpoints_come_by_the_clock_and_two_stay(world: World, tmp_path: Path) -> None:
    seen: list[int] = []

    def count(step: int, batch: Batch) -> Batch:
        seen.append(len(checkpoint.steps(tmp_path / "run" / "checkpoints")))
        return batch

    run = trained_for(
        world, tmp_path / "run", replace(world.config, steps=5, checkpoint_minutes=1e-9), change=count
    )
    assert seen == [0, 1, 2, 2, 2] and checkpoint.steps(run.checkpoints) == [4, 5]


TINY = torch.finfo(torch.float32).tiny


def bad_gradients(
    world: World, folder: Path, config: TrainConfig, value: float, *bad: int, stop: int = -1
) -> Run:
    """Train where the loss is fine, and one number of one gradient isn't, in the steps `bad`; interrupted in
    step `stop`.
    """
    steps = [-1]
    interrupt = stopping(stop)

    def watch(step: int, batch: Batch) -> Batch:
        steps.append(step)
        return interrupt(step, batch)

    def spoil(gradient: torch.Tensor) -> torch.Tensor:
        if steps[-1] in bad:
            gradient = gradient.clone()
            gradient.view(-1)[0] = value
        return gradient

    model = build_model(config, world.prepared.facts)
    model.learned()[1].register_hook(spoil)
    folder.mkdir(exist_ok=True)
    prepared = world.prepared._replace(manager=Altered(world.prepared.manager, watch))
    taught(config, prepared, Run(folder), model=model)
    return Run(folder)


@pytest.mark.parametrize("kind", ["loss", "gradient"])
def test_a_step_that_is_not_finite_changes_nothing_and_is_named(
    world: World, tmp_path: Path, kind: str
) -> None:
    config = replace(world.config, steps=4)
    three = tmp_path / "three"
    reports = list[Report]()
    stopped(world, three, config, stopping(3))
    if kind == "loss":
        run = trained_for(world, tmp_path / "four", config, change=spoilt(NAN, 3), report=reports.append)
        assert reports[-1].skipped == 1 and all(
            math.isfinite(v) for v in (reports[-1].psnr, *reports[-1].losses.values())
        )
    else:
        run = bad_gradients(world, tmp_path / "four", config, 3e38, 3)
    assert same(parameters(Run(three), 3), parameters(run, 4))
    (event,) = events(run, "skipped")
    assert event["step"] == 3 and event["skipped"].startswith(
        "rgb" if kind == "loss" else "the loss or a gradient"
    )


def test_a_run_with_skipped_steps_is_the_same_when_it_is_resumed(world: World, tmp_path: Path) -> None:
    """Before and after the interruption."""
    config = replace(world.config, steps=10)
    straight = bad_gradients(world, tmp_path / "straight", config, NAN, 2, 3, 7)
    with pytest.raises(KeyboardInterrupt):
        bad_gradients(world, tmp_path / "halves", config, NAN, 2, 3, 7, stop=5)
    halves = bad_gradients(world, tmp_path / "halves", config, NAN, 2, 3, 7)
    assert same(parameters(straight, 10), parameters(halves, 10))
    assert (
        [e["step"] for e in events(straight, "skipped")]
        == [e["step"] for e in events(halves, "skipped")]
        == [2, 3, 7]
    )


def test_three_in_a_row_go_back_to_the_last_checkpoint_once(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=12)
    folder = tmp_path / "run"
    stopped(world, folder, config, stopping(4))
    kept = parameters(Run(folder), 4)
    with pytest.raises(NumericsError, match=r"step 8: .* in a row, again after going back to step 4; lower"):
        trained_for(world, folder, config, change=spoilt(NAN, 6, 7, 8))
    (event,) = events(Run(folder), "gone_back_to")
    assert (event["step"], event["gone_back_to"]) == (8, 4) and "rgb is not finite" in event["because"]
    assert [e["step"] for e in events(Run(folder), "skipped")] == [6, 7, 8, 6, 7, 8]
    assert checkpoint.steps(Run(folder).checkpoints) == [4] and same(kept, parameters(Run(folder), 4))


def test_a_passing_fault_costs_the_steps_since_the_checkpoint_and_nothing_else(
    world: World, tmp_path: Path
) -> None:
    """Something that hits once, as a failing device does: after going back the run is the one without it."""
    config = replace(world.config, steps=9)
    folder = tmp_path / "run"
    left = [5, 6, 7]
    stopped(world, folder, config, stopping(3))

    def once(step: int, batch: Batch) -> Batch:
        return spoilt(NAN, left.pop(0))(step, batch) if step in left else batch

    run = trained_for(world, folder, config, change=once)
    assert not left and len(events(run, "gone_back_to")) == 1
    assert same(parameters(run, 9), parameters(trained_for(world, tmp_path / "clean", config), 9))


@pytest.mark.parametrize("bad", [[], [3]])
def test_held_gradients_teach_what_plain_torch_does(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: list[int]
) -> None:
    """Also after a step that was skipped, whose gradients must not stay."""
    monkeypatch.setattr(triplane, "_MAX_SLICED_NUMBERS", 0)
    config = replace(world.config, steps=6)

    def change(step: int, batch: Batch) -> Batch:
        return spoilt(NAN, step)(step, batch) if step in bad else batch

    held = trained_for(world, tmp_path / "held", config, change=change)
    with backend.plain():
        plain = trained_for(world, tmp_path / "plain", config, change=change)
    ours = parameters(held, 6)
    theirs = parameters(plain, 6)
    assert ours.keys() == theirs.keys()
    for name, value in theirs.items():
        if name.endswith(".step"):
            assert torch.equal(ours[name], value), "each step counts once"
        else:
            assert (ours[name].double() - value.double()).norm() <= 1e-3 * value.double().norm(), name


def faded(steps: int, clear: bool) -> tuple[nn.Parameter, torch.optim.Optimizer]:
    """One gradient, then none, as for what is never seen again."""
    parameter = nn.Parameter(torch.linspace(-1, 1, 64))
    optimizer = torch.optim.Adam([parameter], lr=1e-2, betas=(0.9, 0.99), eps=1e-12, fused=True)
    for step in range(steps):
        parameter.grad = torch.linspace(-1, 1, 64) ** 5 if step == 0 else torch.zeros(64)
        optimizer.step()
        if clear and (step + 1) % CLEAR_EVERY == 0:
            clear_denormals(optimizer)
    return parameter, optimizer


def denormal(optimizer: torch.optim.Optimizer) -> int:
    (state,) = optimizer.state.values()
    return sum(int(((t != 0) & (t.abs() < TINY)).sum()) for t in (state["exp_avg"], state["exp_avg_sq"]))


def test_moments_fade_to_zero_and_not_into_denormals() -> None:
    plain, before = faded(2000, clear=False)
    cleared, after = faded(2000, clear=True)
    assert denormal(before) > 0, "else there is nothing to guard against"
    assert denormal(after) == 0
    assert float((plain - cleared).detach().abs().max()) < 1e-12


def signalled(at: int, *numbers: int) -> Change:
    def change(step: int, batch: Batch) -> Batch:
        for number in numbers if step == at else ():
            os.kill(os.getpid(), number)
        return batch

    return change


def test_the_first_signal_lets_the_step_end_and_the_second_saves_nothing_doubtful(
    world: World, tmp_path: Path
) -> None:
    config = replace(world.config, steps=9)
    run = Run(tmp_path / "run")
    stopped(world, run.root, config, signalled(3, signal.SIGTERM))
    assert checkpoint.steps(run.checkpoints) == [4]
    before = parameters(run, 4)
    stopped(world, run.root, config, signalled(7, signal.SIGINT, signal.SIGINT))
    assert checkpoint.steps(run.checkpoints) == [4] and same(before, parameters(run, 4))
    ends = [parameters(trained_for(world, tmp_path / name, config), 9) for name in ("run", "straight")]
    assert same(*ends)


def test_handlers_that_were_not_set_from_python_stay(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    change = Mock(return_value=None)
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    monkeypatch.setattr(signal, "signal", change)
    trained_for(world, tmp_path / "run", replace(world.config, steps=1))
    change.assert_not_called()
