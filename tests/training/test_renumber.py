"""Folders of trained blocks follow their blocks to other numbers."""

import json
import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fprf.training.block_plan import renumber, trained_tasks
from fprf.training.blocks import folder_of

tasks = st.lists(st.sampled_from("abcdefgh"), unique=True, max_size=6)


def lay(root: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        folder = folder_of(root, number)
        folder.mkdir(parents=True)
        (folder / "task.json").write_text(json.dumps({"task": name}))
        (folder / "weights").write_text(name)


def held(root: Path) -> dict[str, str]:
    return {folder.name: (folder / "weights").read_text() for folder in (root / "blocks").glob("*") if folder.is_dir()}


@given(tasks, tasks)
def test_each_block_finds_what_was_trained_for_it(before: list[str], now: list[str]) -> None:
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        lay(root, before)
        renumber(root, dict(enumerate(now)))
        found = held(root)
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
        assert {k: v for k, v in held(root).items() if k.isdigit()} == {f"{k:02d}": v for k, v in now.items()}


def test_marks_that_were_cut_short_do_not_count(tmp_path: Path) -> None:
    lay(tmp_path, ["a", "b", "c"])
    (folder_of(tmp_path, 1) / "task.json").write_text('{"task"')
    (folder_of(tmp_path, 2) / "task.json").write_text("[]")
    assert trained_tasks(tmp_path) == {folder_of(tmp_path, 0): "a"}
    assert trained_tasks(tmp_path / "nowhere") == {}
