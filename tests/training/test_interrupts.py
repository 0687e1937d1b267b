import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_world import World, parameters, trained_for

from fprf.training import checkpoint
from fprf.training.loop import held_back
from fprf.training.run import Run
from fprf.types import Batch


def signalled(at: int, *numbers: int):  # type: ignore[no-untyped-def]
    def change(step: int, batch: Batch) -> Batch:
        for number in numbers if step == at else ():
            os.kill(os.getpid(), number)
        return batch

    return change


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_lets_the_step_end(world: World, tmp_path: Path, number: int) -> None:
    config = replace(world.config, steps=9)
    with pytest.raises(KeyboardInterrupt):
        trained_for(world, tmp_path / "run", config, change=signalled(4, number))
    assert checkpoint.steps(Run(tmp_path / "run").checkpoints) == [5]
    ends = [parameters(trained_for(world, tmp_path / name, config), 9) for name in ("run", "straight")]
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[1])


def test_the_second_one_ends_it_at_once_and_saves_nothing_doubtful(world: World, tmp_path: Path) -> None:
    config = replace(world.config, steps=9)
    with pytest.raises(KeyboardInterrupt):
        trained_for(world, tmp_path / "run", config, change=signalled(3, signal.SIGTERM))
    before = parameters(Run(tmp_path / "run"), 4)
    with pytest.raises(KeyboardInterrupt):
        trained_for(world, tmp_path / "run", config, change=signalled(7, signal.SIGINT, signal.SIGINT))
    assert checkpoint.steps(Run(tmp_path / "run").checkpoints) == [4]
    after = parameters(Run(tmp_path / "run"), 4)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_signals_are_as_before_afterwards() -> None:
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with held_back() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.asked and not stop.hurried
        with pytest.raises(KeyboardInterrupt):
            stop.obey()
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before


def test_another_thread_trains_without_touching_signals() -> None:
    found: list[object] = []

    def work() -> None:
        with held_back() as stop:
            stop.obey()
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.getsignal(signal.SIGINT)]
