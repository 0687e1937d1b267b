import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World, parameters, spoilt, stopping, trained_for

from fprf.datamanagers.batches import generator_of
from fprf.errors import CheckpointError
from fprf.training import checkpoint
from fprf.training.run import Run
from fprf.training.trainer import Report
from fprf.types import Batch

NAN, INF = float("nan"), float("inf")


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_a_resumed_run_is_bitwise_the_one_that_never_stopped(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=12)
    straight = trained_for(world, tmp_path / "straight", config)
    folder = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        trained_for(world, folder, config, change=stopping(6))
    assert checkpoint.steps(Run(folder).checkpoints) == [6], "an interrupt saves first"
    resumed = trained_for(world, folder, config)
    assert checkpoint.steps(resumed.checkpoints) == [6, 12]
    assert same(parameters(straight, 12), parameters(resumed, 12))
    assert not same(parameters(resumed, 6), parameters(resumed, 12))


def test_a_damaged_checkpoint_costs_its_steps_alone_and_is_named(world: World, tmp_path: Path) -> None:
    config, folder = replace(world.config, steps=8), tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        trained_for(world, folder, config, change=stopping(4))
    run = trained_for(world, folder, config)
    whole = parameters(run, 8)
    path = run.checkpoints / "step-0000008" / "model.safetensors"
    path.write_bytes(path.read_bytes()[:200])
    trained_for(world, folder, config)
    assert same(whole, parameters(run, 8))
    assert "step-0000008/model.safetensors" in (folder / "events.jsonl").read_text()


def test_all_checkpoints_damaged_is_told_not_trained_over(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=2)
    run = trained_for(world, tmp_path / "run", config)
    (run.checkpoints / "step-0000002" / "optimizer.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError, match="no intact checkpoint"):
        trained_for(world, tmp_path / "run", config)


def test_threads_change_no_more_than_roundings(world: World, tmp_path: Path) -> None:
    config, before = replace(world.config, steps=4), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(parameters(trained_for(world, tmp_path / str(threads), config), 4))
    finally:
        torch.set_num_threads(before)
    one, two = found
    assert one.keys() == two.keys()
    apart = {name: float((one[name].double() - two[name].double()).abs().max()) for name in one}
    assert max(apart.values()) < 1e-6


def test_another_seed_is_another_run(world: World, tmp_path: Path) -> None:
    first = parameters(trained_for(world, tmp_path / "a", replace(world.config, steps=2)), 2)
    again = parameters(trained_for(world, tmp_path / "b", replace(world.config, steps=2)), 2)
    other = parameters(trained_for(world, tmp_path / "c", replace(world.config, steps=2, seed=1)), 2)
    assert same(first, again) and not same(first, other)


def test_a_finished_run_stays_as_it_is(world: World, tmp_path: Path) -> None:
    run = trained_for(world, tmp_path / "run", replace(world.config, steps=2))
    before = {p: p.stat().st_mtime_ns for p in run.checkpoints.rglob("*")}
    reports: list[Report] = []
    trained_for(world, tmp_path / "run", replace(world.config, steps=2), report=reports.append)
    assert {p: p.stat().st_mtime_ns for p in run.checkpoints.rglob("*")} == before and not reports


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

    run = trained_for(world, tmp_path / "run", replace(world.config, steps=5, checkpoint_minutes=1e-9), change=count)
    assert seen == [0, 1, 2, 2, 2] and checkpoint.steps(run.checkpoints) == [4, 5]


@pytest.mark.parametrize("value", [NAN, INF])
def test_a_step_without_a_finite_loss_changes_nothing(world: World, tmp_path: Path, value: float) -> None:
    config = replace(world.config, steps=4)
    with pytest.raises(KeyboardInterrupt):
        trained_for(world, tmp_path / "three", config, change=stopping(3))
    reports: list[Report] = []
    spoiling = spoilt(value, 3)
    run = trained_for(world, tmp_path / "four", config, change=spoiling, report=reports.append)
    assert same(parameters(Run(tmp_path / "three"), 3), parameters(run, 4))
    last = reports[-1]
    assert last.skipped == 1 and math.isfinite(last.psnr) and all(math.isfinite(v) for v in last.losses.values())


def test_training_learns(world: World, tmp_path: Path) -> None:
    reports: list[Report] = []
    trained_for(world, tmp_path / "run", replace(world.config, steps=40), report=reports.append)
    last = reports[-1]
    assert last.psnr > 13 and last.step == 40 and last.share == 1 and last.rays_per_second > 0
    assert 0 < last.kept <= 1 and set(last.losses) >= {"rgb", "content", "semantic", "distortion", "variation"}


def test_draws_of_a_step_depend_on_seed_and_step_alone() -> None:
    def draw(seed: int, step: int) -> float:
        return float(torch.rand((), generator=generator_of(seed, step, purpose="draws")))

    assert draw(3, 7) == draw(3, 7)
    assert len({draw(seed, step) for seed in (0, 1, 2**31 - 1) for step in range(50)}) == 150
