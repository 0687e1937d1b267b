"""Blocks as tasks: idempotent, resumed to the bit, trained again only where they are concerned."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from block_world import BlockWorld, block_flags, digests, done_of, small, steps_of, tensors_of

from fprf.cli.train import train_scene
from fprf.errors import CheckpointError, ConfigError, DataError
from fprf.fields.layouts import AdaptiveConfig
from fprf.training import trainer
from fprf.training.blocks import SURROUNDINGS, BlockTask, train_block
from fprf.training.loading import load_run
from fprf.training.trainer import Report

NAMES = ("surroundings", "00", "01", "02")


def task(world: BlockWorld, root: Path, block: int) -> BlockTask:
    return BlockTask(root=str(root), data=str(world.config.data), block=block, minutes=None, quiet=True)


def copy_of(world: BlockWorld, folder: Path) -> Path:
    shutil.copytree(world.root, folder / "run")
    return folder / "run"


def same(root: Path, other: Path, name: str) -> bool:
    mine, theirs = tensors_of(root, name), tensors_of(other, name)
    return mine.keys() == theirs.keys() and all(torch.equal(mine[k], theirs[k]) for k in mine)


def stamps(root: Path, name: str) -> list[int]:
    return [
        p.stat().st_mtime_ns
        for p in sorted((root / "blocks" / name).rglob("*"))
        if p.is_file() and p.name != "rays.safetensors"
    ]


def test_a_finished_block_is_left_alone(block_world: BlockWorld, tmp_path: Path) -> None:
    root = copy_of(block_world, tmp_path)
    before = stamps(root, "01")
    assert not train_block(task(block_world, root, 1), lambda event: None)
    assert not train_block(task(block_world, root, SURROUNDINGS), lambda event: None)
    # Its part of a time limit is another in every call; that is no reason to train on.
    assert not train_block(replace(task(block_world, root, 1), minutes=7.5), lambda event: None)
    assert stamps(root, "01") == before


@pytest.mark.parametrize("block", [SURROUNDINGS, 0])
def test_an_interrupted_block_goes_on_to_the_same_bits(
    block_world: BlockWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int
) -> None:
    root, name = copy_of(block_world, tmp_path), "surroundings" if block == SURROUNDINGS else f"{block:02d}"
    shutil.rmtree(root / "blocks" / name / "checkpoints")
    (root / "blocks" / name / "done.json").unlink()
    monkeypatch.setattr(trainer, "REPORT_SECONDS", -1.0)
    seen: list[int] = []

    def interrupt(event: Report) -> None:
        seen.append(event.step)
        if event.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_block(task(block_world, root, block), interrupt)
    assert not (root / "blocks" / name / "done.json").exists()
    with pytest.raises(CheckpointError, match="not finished; go on with `fprf train"):
        load_run(root, "cpu")
    assert train_block(task(block_world, root, block), lambda event: seen.append(event.step))
    assert seen[:4] == [1, 2, 3, 4], "it must not start over"
    assert same(root, block_world.root, name)


def test_two_workers_on_a_block_the_second_is_told_and_changes_nothing(block_world: BlockWorld, tmp_path: Path) -> None:
    """It is refused while the first holds the folder, and finds the block finished afterwards; other blocks are free."""
    root = copy_of(block_world, tmp_path)
    shutil.rmtree(root / "blocks/01/checkpoints")
    (root / "blocks/01/done.json").unlink()
    met: list[str] = []

    def meanwhile(event: Report) -> None:
        with pytest.raises(DataError, match=r"01: process \d+ on .+ is training here"):
            train_block(task(block_world, root, 1), lambda event: None)
        assert not train_block(task(block_world, root, 2), lambda event: None)
        met.append("refused")

    assert train_block(task(block_world, root, 1), meanwhile)
    assert met and same(root, block_world.root, "01")
    assert not train_block(task(block_world, root, 1), lambda event: None)
    assert not (root / "blocks/01/.lock").exists()


def test_another_task_in_the_folder_starts_anew(block_world: BlockWorld, tmp_path: Path) -> None:
    root = copy_of(block_world, tmp_path)
    document = json.loads((root / "config.json").read_text())
    document["config"]["seed"] = 5
    (root / "config.json").write_text(json.dumps(document))
    (root / "blocks/00/events.jsonl").write_text('{"step": 99}\n')
    assert train_block(task(block_world, root, 0), lambda event: None)
    assert not same(root, block_world.root, "00")
    assert done_of(root, "00")["step"] == 6 and not (root / "blocks/00/events.jsonl").exists()


def test_more_steps_go_on_from_where_it_stopped(block_world: BlockWorld, tmp_path: Path) -> None:
    root = copy_of(block_world, tmp_path)
    train_scene(replace(small(block_world.config.data, root), steps=8), "fprf-lite", quiet=True)
    for name in NAMES:
        assert done_of(root, name)["step"] == 8
        assert steps_of(root, name)[-2:] == [6, 8], "the log goes on"
    assert digests(root, NAMES) == digests(block_world.root, NAMES)


def test_views_of_another_scene_are_refused(block_world: BlockWorld, tmp_path: Path) -> None:
    from fprf.training import tensorfiles

    root = copy_of(block_world, tmp_path)
    rays = root / "blocks/01/rays.safetensors"
    seen = tensorfiles.read(rays)["seen"].clone()
    tensorfiles.save(rays, {"views": torch.arange(len(seen)) + 40, "seen": seen})
    with pytest.raises(ConfigError, match="its views are not those of town"):
        train_block(task(block_world, root, 1), lambda event: None)


def test_another_cut_trains_only_the_blocks_that_it_concerns(block_world: BlockWorld, tmp_path: Path) -> None:
    """Halving the heaviest block leaves the others what they were, under whatever number."""
    town = block_world.config.data
    coarse, fine = AdaptiveConfig(rays=3700, smallest=2.0), AdaptiveConfig(rays=3300, smallest=2.0)
    config = replace(small(town, tmp_path / "run"), blocks=coarse)
    train_scene(config, "fprf-lite", quiet=True)
    root = tmp_path / "run"
    first = {folder.name: done_of(root, folder.name) for folder in (root / "blocks").iterdir()}
    train_scene(replace(config, blocks=fine), "fprf-lite", quiet=True)
    second = {folder.name: done_of(root, folder.name) for folder in (root / "blocks").iterdir()}
    assert (len(first), len(second)) == (4, 5)
    kept = {one["asked"]["task"] for one in first.values()} & {one["asked"]["task"] for one in second.values()}
    assert len(kept) == 3, "the surroundings, and the two blocks that were not split"
    assert first["01"]["asked"] == second["02"]["asked"], "they have other numbers now"
    for one in second.values():
        old = next((was for was in first.values() if was["asked"]["task"] == one["asked"]["task"]), None)
        if old is not None:
            assert (one["seconds"], one["tensors"]) == (old["seconds"], old["tensors"])
    load_run(root, "cpu")


def test_a_block_whose_images_changed_is_trained_again(block_world: BlockWorld, tmp_path: Path) -> None:
    from fprf.datamanagers.images import load_image
    from fprf.io.images import write_image

    root, town = copy_of(block_world, tmp_path), tmp_path / "town"
    shutil.copytree(block_world.config.data, town)
    picture = town / "images/0003.png"
    write_image(picture, 255 - load_image(picture))
    moved = replace(task(block_world, root, 0), data=str(town))
    assert train_block(moved, lambda event: None)
    assert not same(root, block_world.root, "00")


@pytest.mark.parametrize(
    "spoil, said",
    [
        (lambda folder: (folder / "done.json").write_text("{"), "cannot be read"),
        (lambda folder: (folder / "done.json").write_text('{"format": 1, "step": 6}'), "cannot be read"),
        (lambda folder: (folder / "block.safetensors").write_bytes(b"x" * 40), "cannot be read"),
        (lambda folder: (folder / "done.json").unlink(), "not finished"),
    ],
)
def test_damaged_blocks_are_named(block_world: BlockWorld, tmp_path: Path, spoil, said: str) -> None:  # type: ignore[no-untyped-def]
    root = copy_of(block_world, tmp_path)
    spoil(root / "blocks/surroundings")
    with pytest.raises(CheckpointError, match=said):
        load_run(root, "cpu")


@pytest.mark.fault
@pytest.mark.timeout(600)
def test_a_killed_block_is_resumed_to_the_same_bits(block_world: BlockWorld, tmp_path: Path) -> None:
    """SIGKILL in the middle of block after block; each call goes on from the last checkpoint."""
    steps, root = 60, tmp_path / "run"
    calm = tmp_path / "calm"
    train_scene(replace(small(block_world.config.data, calm), steps=steps), "fprf-lite", quiet=True)
    command = [sys.executable, "-m", "fprf", "train", "fprf-lite", *block_flags(block_world.config.data, root, steps)]
    command += ["--checkpoint-minutes", "1e-9"]
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
        assert same(root, calm, name), name
