"""Parts of a scene as tasks, of both kinds: lost, interrupted, killed, contended, gone on with,
renumbered.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts_world import TaskWorld
from tiny_world import events, same

from fprf.errors import CheckpointError, DataError
from fprf.interfaces import Executor
from fprf.progress import Report
from fprf.splats.config import GaussiansConfig
from fprf.training import driver
from fprf.training.driver import train
from fprf.training.loading import open_run
from fprf.training.run import Run
from fprf.training.tasks import WHOLE, Task, renumber, task_of, train_all


@pytest.mark.parametrize("part", [WHOLE, 0])
def test_an_interrupted_part_goes_on_to_the_same_bits(
    task_world: TaskWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: int
) -> None:
    root = task_world.copy(tmp_path)
    folder = task_world.unfinish(root, part)
    monkeypatch.setattr(driver, "REPORT_SECONDS", -1.0)
    seen: list[int] = []

    def interrupt(event: Report) -> None:
        seen.append(event.step)
        if event.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        task_world.train(root, part, interrupt)
    assert not (folder / "done.json").exists()
    assert task_world.train(root, part, lambda event: seen.append(event.step))
    assert seen[:4] == [1, 2, 3, 4], "it must not start over"
    assert same(task_world.tensors(root, part), task_world.tensors(task_world.root, part))


def test_a_lost_part_is_trained_again_and_changes_nothing_else(task_world: TaskWorld, tmp_path: Path) -> None:
    root = task_world.copy(tmp_path)
    stamps = {path: path.stat().st_mtime_ns for path in root.glob("**/done.json")}
    assert len(stamps) == 1 + task_world.parts
    shutil.rmtree(task_world.folder_of(root, 1))
    with pytest.raises(CheckpointError, match="not finished; go on with `fprf train"):
        open_or_unite(task_world, root)
    train(replace(task_world.config, output=root), task_world.method, quiet=True)
    changed = [path.parent for path, stamp in stamps.items() if path.stat().st_mtime_ns != stamp]
    assert changed == [task_world.folder_of(root, 1)]
    assert same(task_world.tensors(root, 1), task_world.tensors(task_world.root, 1))
    view = open_run(root, "cpu").scene.cameras
    first, second = (open_run(each, "cpu").scene.render(view, 0).rgb for each in (root, task_world.root))
    assert bool((first == second).all())


def open_or_unite(world: TaskWorld, root: Path) -> None:
    """What needs all parts: blocks are blended when they are rendered, cells united when they are trained."""
    from fprf.splats.cells import load_cells, unite

    if world.method == "fprf-splats":
        unite(root, load_cells(root))
    else:
        open_run(root, "cpu")


def test_two_workers_on_a_part_the_second_is_told_and_changes_nothing(
    task_world: TaskWorld, tmp_path: Path
) -> None:
    """It is refused while the first holds the folder, and finds the part finished afterwards; others are
    free.
    """
    root = task_world.copy(tmp_path)
    task_world.unfinish(root, 1)
    met: list[str] = []

    def meanwhile(event: Report) -> None:
        with pytest.raises(DataError, match=r"01: process \d+ on .+ is training here"):
            task_world.train(root, 1)
        assert not task_world.train(root, 0)
        met.append("refused")

    assert task_world.train(root, 1, meanwhile)
    assert met and same(task_world.tensors(root, 1), task_world.tensors(task_world.root, 1))
    # Its part of a time limit is another in every call; that is no reason to train on.
    for minutes in (None, 7.5):
        assert not task_world.train(root, 1, minutes=minutes)
    assert not (task_world.folder_of(root, 1) / ".lock").exists()


@pytest.mark.parametrize("other", ["seed", "images"])
def test_another_task_in_the_folder_starts_anew(task_world: TaskWorld, tmp_path: Path, other: str) -> None:
    root = task_world.copy(tmp_path)
    town = tmp_path / "town"
    shutil.copytree(task_world.data, town)
    if other == "seed":
        config, method = Run(root).load_config()
        Run(root).save_config(replace(config, seed=5), method)
    else:
        shutil.copy(town / "images/0004.png", town / "images/0003.png")
    folder = task_world.folder_of(root, 0)
    before = task_of(task_world.folder_of(root, 0))
    (folder / "events.jsonl").write_text('{"step": 99}\n')
    assert task_world.train(root, 0, data=town)
    assert not same(task_world.tensors(root, 0), task_world.tensors(task_world.root, 0))
    assert task_of(folder) != before and not (folder / "events.jsonl").exists()


def test_more_steps_go_on_from_where_it_stopped(task_world: TaskWorld, tmp_path: Path) -> None:
    root = task_world.copy(tmp_path)
    steps = 2 * task_world.config.steps
    train(replace(task_world.config, output=root, steps=steps), task_world.method, quiet=True)
    for part in range(task_world.parts):
        before, after = (task_world.done(each, part) for each in (task_world.root, root))
        assert after["step"] == 2 * before["step"] and after["asked"]["task"] == before["asked"]["task"]
        made = [event["step"] for event in events(Run(task_world.folder_of(root, part)), "step")]
        assert made == sorted(made) and made[-1] == after["step"] and before["step"] in made, (
            "the log goes on"
        )


class Remembering(Executor):
    """Takes a minute for each task, and remembers them."""

    def __init__(self, clock: list[float]) -> None:
        self.clock = clock
        self.given = list[list[Task]]()

    def map(self, function: Any, tasks: Sequence[Any]) -> list[Any]:
        self.given.append(list(tasks))
        self.clock[0] += 60 * sum(task.minutes or 0 for task in tasks)
        return [None for _ in tasks]


@pytest.mark.parametrize(("spent", "left"), [(60.0, 9.0), (1e4, 0.5)], ids=["in time", "late"])
def test_a_time_limit_is_shared_between_the_whole_scene_and_its_parts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, spent: float, left: float
) -> None:
    clock = [1e6]
    monkeypatch.setattr("fprf.training.tasks.time", SimpleNamespace(perf_counter=lambda: clock[0]))
    executor = Remembering(clock)
    config = GaussiansConfig(data=tmp_path, minutes=10.0)
    train_all(
        config, Run(tmp_path), executor, pytest.fail, [2, 0, 1], whole_share=0.2, spent=spent, quiet=True
    )
    (whole,), parts = executor.given
    assert (whole.part, [task.part for task in parts]) == (WHOLE, [2, 0, 1])
    assert whole.minutes == pytest.approx(0.2 * left)
    assert sum(task.minutes or 0 for task in parts) == pytest.approx(max(left - 0.2 * left, 0.5))


tasks = st.lists(st.sampled_from("abcdefgh"), unique=True, max_size=6)


def lay(folder: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        part = folder / f"{number:02d}"
        part.mkdir()
        (part / "task.json").write_text(json.dumps({"task": name}))
        (part / "weights").write_text(name)


def weights_in(folder: Path) -> dict[str, str]:
    return {part.name: (part / "weights").read_text() for part in folder.glob("*") if part.is_dir()}


@given(tasks, tasks)
def test_each_part_finds_what_was_trained_for_it(before: list[str], now: list[str]) -> None:
    with tempfile.TemporaryDirectory() as name:
        lay(Path(name), before)
        renumber(Path(name), dict(enumerate(now)))
        found = weights_in(Path(name))
        for number, task in enumerate(now):
            if task in before:
                assert found[f"{number:02d}"] == task
        assert not [name for name in found if not name.isdigit()]


@given(tasks, st.permutations(range(6)), st.integers(0, 12))
def test_cut_off_anywhere_the_next_call_finishes_it(before: list[str], order: list[int], until: int) -> None:
    now = {number: before[at] for number, at in enumerate([k for k in order if k < len(before)])}
    real = os.rename
    left = [until]

    def rename(source: Path, target: Path) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        real(source, target)

    with tempfile.TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        lay(Path(name), before)
        patch.setattr(os, "rename", rename)
        try:
            renumber(Path(name), now)
        except KeyboardInterrupt:
            left[0] = 99
            renumber(Path(name), now)
        assert {k: v for k, v in weights_in(Path(name)).items() if k.isdigit()} == {
            f"{k:02d}": v for k, v in now.items()
        }


@pytest.mark.fault
@pytest.mark.timeout(600)
def test_killed_parts_are_resumed_to_the_same_bits(task_world: TaskWorld, tmp_path: Path) -> None:
    """SIGKILL in the middle of one part after the other; each call goes on from the last checkpoint."""
    steps = 8 * task_world.config.steps
    calm = tmp_path / "calm"
    root = tmp_path / "run"
    config = replace(task_world.config, steps=steps, output=calm)
    train(config, task_world.method, quiet=True)
    root.mkdir()
    Run(root).save_config(replace(config, output=None, checkpoint_minutes=1e-9), task_world.method)
    command = [sys.executable, "-m", "fprf", "train", str(root / "config.json")]
    killed = []
    for part in (WHOLE, 1):
        worker = subprocess.Popen(
            command,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        folder = task_world.folder_of(root, part)
        while worker.poll() is None and len(list(folder.glob("checkpoints/step-*/manifest.json"))) < 2:
            time.sleep(0.005)
        worker.send_signal(signal.SIGKILL)
        worker.wait()
        killed.append((folder / "done.json").exists())
    assert not all(killed), "no part was caught in the middle"
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    for part in (WHOLE, *range(task_world.parts)):
        assert task_world.done(root, part)["step"] == task_world.done(calm, part)["step"]
        # Of cells the digest of the whole scene holds the seconds that it took; what was learnt is the same.
        assert same(task_world.tensors(root, part), task_world.tensors(calm, part)), part
