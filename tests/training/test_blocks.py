"""Scenes of blocks: the cut, tasks that are resumed to the bit, finished blocks in files and in memory."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from block_world import BlockWorld, done_of, small, tensors_of, unfinish
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import events, same

from fprf.blocks.config import AdaptiveConfig
from fprf.blocks.fields import Member
from fprf.blocks.visibility import make_plan
from fprf.errors import CheckpointError, DataError
from fprf.training import driver, tensorfiles
from fprf.training.block_plan import BlockTask, renumber, train_block
from fprf.training.blocks import (
    RAYS,
    SURROUNDINGS,
    Built,
    asked_of,
    folder_of,
    load_blocks,
    load_finished,
    read_done,
    restore,
    save_finished,
    surroundings,
)
from fprf.training.driver import Report, train
from fprf.training.loading import Shelf, load_run
from fprf.training.prepare import read_scene
from fprf.training.run import Run


def around_of(world: BlockWorld) -> Built:
    """The surroundings at their start."""
    return surroundings(world.config, Run(world.root).load_known().facts, load_blocks(world.root))


def test_finished_blocks_come_back_and_what_does_not_fit_is_refused(block_world: BlockWorld, tmp_path: Path) -> None:
    built, other = around_of(block_world), around_of(block_world).member
    assert read_done(tmp_path) is None
    save_finished(tmp_path, built, asked={"task": "x"}, step=7, seconds=1.5)
    found = load_finished(tmp_path)
    assert (found.step, found.seconds) == (7, 1.5)
    for parameter in other.parameters():
        parameter.detach().zero_()
    restore(other, "member", found.tensors)
    torch.testing.assert_close(other.state_dict(), built.member.state_dict(), atol=0, rtol=0)
    first = next(name for name in found.tensors if name.startswith("member."))
    for wrong in (
        {name: tensor for name, tensor in found.tensors.items() if name != first},
        found.tensors | {first: found.tensors[first][:1]},
        found.tensors | {"member.more": torch.zeros(1)},
    ):
        with pytest.raises(CheckpointError):
            restore(other, "member", wrong)


def asked(world: BlockWorld, block: int, **change: Any) -> str:
    """Digest of a block's task in a config with other fields."""
    config = replace(world.config, **change)
    scene = read_scene(config)
    plan = make_plan(scene, config.blocks)
    rays = tensorfiles.read(folder_of(world.root, block) / RAYS)
    digest: str = asked_of(config, Run(world.root).load_known().facts, scene, plan.cells, block, rays)["task"]
    return digest


def test_each_block_knows_its_views_and_tiles(block_world: BlockWorld) -> None:
    scene = read_scene(block_world.config)
    plan = make_plan(scene, block_world.config.blocks)
    assert len(load_blocks(block_world.root)) == 3
    for block in range(3):
        rays = tensorfiles.read(folder_of(block_world.root, block) / RAYS)
        assert torch.equal(rays["views"], plan.views_of(block))
        assert torch.equal(rays["seen"].bool(), plan.seen[torch.isin(plan.views, rays["views"]), block])
    around = tensorfiles.read(folder_of(block_world.root, SURROUNDINGS) / RAYS)
    assert torch.equal(around["views"], scene.train) and bool(around["seen"].bool().all())


def test_what_makes_it_another_task_and_what_does_not(block_world: BlockWorld) -> None:
    base, was = block_world.config, asked(block_world, 1)
    assert was == asked(block_world, 1, steps=99, minutes=3.0, checkpoint_minutes=1.0, device="auto")
    others: list[dict[str, Any]] = [
        {"seed": 1},
        {"optimizer": replace(base.optimizer, rate=1e-3)},
        {"content": replace(base.content, moves_density=True)},
        {"loss": replace(base.loss, rgb=2.0)},
    ]
    assert len({was, *(asked(block_world, 1, **other) for other in others)}) == 5


tasks = st.lists(st.sampled_from("abcdefgh"), unique=True, max_size=6)


def lay(root: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        folder = folder_of(root, number)
        folder.mkdir(parents=True)
        (folder / "task.json").write_text(json.dumps({"task": name}))
        (folder / "weights").write_text(name)


def weights_in(root: Path) -> dict[str, str]:
    return {folder.name: (folder / "weights").read_text() for folder in (root / "blocks").glob("*") if folder.is_dir()}


@given(tasks, tasks)
def test_each_block_finds_what_was_trained_for_it(before: list[str], now: list[str]) -> None:
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        lay(root, before)
        renumber(root, dict(enumerate(now)))
        found = weights_in(root)
        for number, task in enumerate(now):
            if task in before:
                assert found[f"{number:02d}"] == task
        assert not [name for name in found if not name.isdigit()]


@given(tasks, st.permutations(range(6)), st.integers(0, 12))
def test_cut_off_anywhere_the_next_call_finishes_it(before: list[str], order: list[int], until: int) -> None:
    now = {number: before[at] for number, at in enumerate([k for k in order if k < len(before)])}
    real, left = os.rename, [until]

    def rename(source: Path, target: Path) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        real(source, target)

    with tempfile.TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        root = Path(name)
        lay(root, before)
        patch.setattr(os, "rename", rename)
        try:
            renumber(root, now)
        except KeyboardInterrupt:
            left[0] = 99
            renumber(root, now)
        assert {k: v for k, v in weights_in(root).items() if k.isdigit()} == {f"{k:02d}": v for k, v in now.items()}


def size_of(world: BlockWorld) -> int:
    """Bytes of one member."""
    return sum(t.numel() * 4 for t in around_of(world).member.state_dict().values())


def test_the_least_recently_used_goes_first(block_world: BlockWorld) -> None:
    room, around = 2, around_of(block_world).member
    restore(around, "member", load_finished(folder_of(block_world.root, SURROUNDINGS)).tensors)
    limit = (room + 1) * size_of(block_world)
    shelf = Shelf(block_world.root, load_blocks(block_world.root), around, device=torch.device("cpu"), limit=limit)
    kept: dict[int, Member] = {}
    for block in (0, 1, 0, 2, 1, 0, 0, 2, 1, 2):
        old, found = kept.pop(block, None), shelf.member(block)
        assert old is None or found is old, "what is at hand is not fetched again"
        kept[block] = found
        if len(kept) > room:
            kept.pop(next(iter(kept)))
        assert shelf.here == tuple(kept)


def test_pictures_do_not_depend_on_the_limit(block_world: BlockWorld) -> None:
    pictures = []
    for limit in (None, 1e-6, 2.5 * size_of(block_world) / (1 << 20)):
        trained = load_run(block_world.root, "cpu", limit)
        trained = replace(trained, config=replace(trained.config, render=replace(trained.config.render, chunk=400)))
        pictures.append(trained.render(trained.cameras, 0).rgb)
    assert torch.equal(pictures[0], pictures[1]) and torch.equal(pictures[0], pictures[2])


NAMES = ("surroundings", "00", "01", "02")


def task(world: BlockWorld, root: Path, block: int) -> BlockTask:
    return BlockTask(root=str(root), data=str(world.config.data), block=block, minutes=None, quiet=True)


def copy_of(world: BlockWorld, folder: Path) -> Path:
    shutil.copytree(world.root, folder / "run")
    return folder / "run"


def same_block(root: Path, other: Path, name: str) -> bool:
    return same(tensors_of(root, name), tensors_of(other, name))


@pytest.mark.parametrize("block", [SURROUNDINGS, 0])
def test_an_interrupted_block_goes_on_to_the_same_bits(
    block_world: BlockWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    root = copy_of(block_world, tmp_path)
    folder = unfinish(root, block)
    monkeypatch.setattr(driver, "REPORT_SECONDS", -1.0)
    seen: list[int] = []

    def interrupt(event: Report) -> None:
        seen.append(event.step)
        if event.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_block(task(block_world, root, block), interrupt)
    assert not (folder / "done.json").exists()
    with pytest.raises(CheckpointError, match="not finished; go on with `fprf train"):
        load_run(root, "cpu")
    assert train_block(task(block_world, root, block), lambda event: seen.append(event.step))
    assert seen[:4] == [1, 2, 3, 4], "it must not start over"
    assert same_block(root, block_world.root, folder.name)


def test_two_workers_on_a_block_the_second_is_told_and_changes_nothing(block_world: BlockWorld, tmp_path: Path) -> None:
    """It is refused while the first holds the folder, and finds the block finished afterwards; other blocks are free."""
    root = copy_of(block_world, tmp_path)
    unfinish(root, 1)
    met: list[str] = []

    def meanwhile(event: Report) -> None:
        with pytest.raises(DataError, match=r"01: process \d+ on .+ is training here"):
            train_block(task(block_world, root, 1), lambda event: None)
        assert not train_block(task(block_world, root, 2), lambda event: None)
        met.append("refused")

    assert train_block(task(block_world, root, 1), meanwhile)
    assert met and same_block(root, block_world.root, "01")
    # Its part of a time limit is another in every call; that is no reason to train on.
    for minutes in (None, 7.5):
        assert not train_block(replace(task(block_world, root, 1), minutes=minutes), lambda event: None)
    assert not (root / "blocks/01/.lock").exists()


@pytest.mark.parametrize("other", ["seed", "images"])
def test_another_task_in_the_folder_starts_anew(block_world: BlockWorld, tmp_path: Path, other: str) -> None:
    root, town = copy_of(block_world, tmp_path), tmp_path / "town"
    shutil.copytree(block_world.config.data or "", town)
    if other == "seed":
        config, method = Run(root).load_config()
        Run(root).save_config(replace(config, seed=5), method)
    else:
        shutil.copy(town / "images/0004.png", town / "images/0003.png")
    (root / "blocks/00/events.jsonl").write_text('{"step": 99}\n')
    assert train_block(replace(task(block_world, root, 0), data=str(town)), lambda event: None)
    assert not same_block(root, block_world.root, "00")
    assert done_of(root, "00")["step"] == 6 and not (root / "blocks/00/events.jsonl").exists()


def test_more_steps_go_on_from_where_it_stopped(block_world: BlockWorld, tmp_path: Path) -> None:
    root = copy_of(block_world, tmp_path)
    train(replace(small(block_world.config.data, root), steps=8), "fprf-lite", quiet=True)
    for name in NAMES:
        assert done_of(root, name)["step"] == 8
        steps = [
            event["step"] for event in events(Run(root / "blocks" / name), "step")
        ]  # as many as there were reports on a slow machine
        assert steps == sorted(steps) and steps[-1] == 8 and 6 in steps, "the log goes on"
        assert done_of(root, name)["asked"]["task"] == done_of(block_world.root, name)["asked"]["task"]


def test_another_cut_trains_only_the_blocks_that_it_concerns(block_world: BlockWorld, tmp_path: Path) -> None:
    """Halving the heaviest block leaves the others what they were, under whatever number."""
    town = block_world.config.data
    coarse, fine = AdaptiveConfig(rays=3700, smallest=2.0), AdaptiveConfig(rays=3300, smallest=2.0)
    config = replace(small(town, tmp_path / "run"), blocks=coarse)
    train(config, "fprf-lite", quiet=True)
    root = tmp_path / "run"
    first = {folder.name: done_of(root, folder.name) for folder in (root / "blocks").iterdir()}
    train(replace(config, blocks=fine), "fprf-lite", quiet=True)
    second = {folder.name: done_of(root, folder.name) for folder in (root / "blocks").iterdir()}
    assert (len(first), len(second)) == (4, 5)
    # The surroundings, and the two blocks that were not split, which have other numbers now.
    assert len([one for one in second.values() if one in first.values()]) == 3
    assert first["01"] == second["02"]
    load_run(root, "cpu")


@pytest.mark.parametrize(
    "name, text",
    [("done.json", "{"), ("done.json", '{"format": 1, "step": 6}'), ("done.json", None), ("block.safetensors", "x" * 40)],
)
def test_damaged_blocks_are_refused(block_world: BlockWorld, tmp_path: Path, name: str, text: str | None) -> None:
    root = copy_of(block_world, tmp_path)
    file = root / "blocks/surroundings" / name
    file.unlink()
    if text is not None:
        file.write_text(text)
    with pytest.raises(CheckpointError):
        load_run(root, "cpu")


@pytest.mark.fault
@pytest.mark.timeout(600)
def test_a_killed_block_is_resumed_to_the_same_bits(block_world: BlockWorld, tmp_path: Path) -> None:
    """SIGKILL in the middle of block after block; each call goes on from the last checkpoint."""
    steps, root = 60, tmp_path / "run"
    calm = tmp_path / "calm"
    config = replace(small(block_world.config.data, calm), steps=steps)
    train(config, "fprf-lite", quiet=True)
    root.mkdir()
    Run(root).save_config(replace(config, output=None, checkpoint_minutes=1e-9), "fprf-lite")
    command = [sys.executable, "-m", "fprf", "train", str(root / "config.json")]
    killed = []
    for name in ("surroundings", "01"):
        worker = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"}
        )
        checkpoints = root / "blocks" / name / "checkpoints"
        while worker.poll() is None and len(list(checkpoints.glob("step-*/manifest.json"))) < 2:
            time.sleep(0.005)
        worker.send_signal(signal.SIGKILL)
        worker.wait()
        killed.append((root / "blocks" / name / "done.json").exists())
    assert not all(killed), "no block was caught in the middle"
    saved = max(int(p.parent.name[5:]) for p in (root / "blocks/01/checkpoints").glob("step-*/manifest.json"))
    assert saved >= 2
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    for name in NAMES:
        assert done_of(root, name)["step"] == steps
        assert same_block(root, calm, name), name
