"""Run folders: what they keep, one process at a time, the images that a run was begun with, its history."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_world import World

from fprf.datamanagers.parsers.config import parse_scene
from fprf.errors import CheckpointError, ConfigError, DataError, UsageError
from fprf.training.facts import facts_from_json, facts_to_json
from fprf.training.history import read_history
from fprf.training.image_hashes import IMAGES, check_images, image_hashes, save_image_hashes
from fprf.training.locks import LOCK, lock_folder
from fprf.training.run import Run, view_names


@pytest.fixture
def run(world: World, tmp_path: Path) -> Run:
    """A copy without checkpoints, to be spoilt."""
    shutil.copytree(world.run, tmp_path / "run", ignore=shutil.ignore_patterns("checkpoints"))
    return Run(tmp_path / "run")


def test_scene_json_gives_the_scene_back(world: World) -> None:
    known = Run(world.run).load_known()
    scene = world.prepared.scene
    for name in ("pose", "focal", "centre", "size", "distortion", "lens"):
        torch.testing.assert_close(getattr(known.cameras, name), getattr(scene.cameras, name), atol=0, rtol=0)
    assert known.names == tuple(p.stem for p in scene.paths)
    assert known.facts == Run(world.run).saved_facts() == world.prepared.facts
    assert Run(world.folder / "none").saved_facts() is None
    assert (known.split("train"), known.split("test")) == (
        tuple(scene.train.tolist()),
        tuple(scene.test.tolist()),
    )
    assert known.split("all") == tuple(sorted(known.train + known.test)) == tuple(range(10))


def test_an_event_after_a_torn_line_has_a_line_of_its_own(tmp_path: Path) -> None:
    torn = '{"step": 2, "los'
    (tmp_path / "events.jsonl").write_text(torn)
    for number in (3, 4):
        Run(tmp_path).log({"step": number})
    assert (tmp_path / "events.jsonl").read_text() == f'{torn}\n{{"step": 3}}\n{{"step": 4}}\n'


@given(st.lists(st.lists(st.sampled_from(["a", "b", "ab"]), min_size=1, max_size=3), min_size=1, max_size=6))
def test_names_are_never_alike(paths: list[list[str]]) -> None:
    names = view_names([Path("/scene", *parts).with_suffix(".png") for parts in paths])
    assert len(set(names)) == len(paths) and not any("/" in name for name in names)


HOLDER = """
import sys, time
from pathlib import Path
from fprf.training.locks import lock_folder
with lock_folder(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_told_who_is_there_until_that_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        with (
            pytest.raises(
                DataError, match=rf"run: process {process.pid} on .+ is training here; wait"
            ) as told,
            lock_folder(folder),
        ):
            pytest.fail("two hold it")
        assert "\n" not in str(told.value)
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    assert (folder / LOCK).exists()
    with lock_folder(folder):
        assert str(os.getpid()) in (folder / LOCK).read_text()
    assert not (folder / LOCK).exists()


def test_who_is_refused_changes_nothing_and_an_empty_folder_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "O_CLOEXEC")  # as on Windows
    folder = tmp_path / "a" / "b"
    with lock_folder(folder):
        with pytest.raises(DataError, match=f"process {os.getpid()}"), lock_folder(folder):
            pytest.fail("two hold it")
        assert (folder / LOCK).exists(), "the holder's file stays"
    assert not folder.exists()
    with pytest.raises(ValueError, match="x"), lock_folder(folder):
        (folder / "file").touch()
        raise ValueError("x")
    assert [p.name for p in folder.iterdir()] == ["file"]
    for place in (folder / "file", folder / "file" / "run"):
        with pytest.raises(DataError), lock_folder(place):
            pass


def write(folder: Path, *events: dict[str, Any] | str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    text = "\n".join(event if isinstance(event, str) else json.dumps(event) for event in events)
    (folder / "events.jsonl").write_text(text)
    return folder


def step(number: int, seconds: float, psnr: float = 20.0, **losses: float) -> dict[str, Any]:
    return {"step": number, "seconds": seconds, "psnr": psnr, "losses": losses}


def test_the_history_of_a_training_that_was_resumed(tmp_path: Path) -> None:
    """What came after the step that it went on from is dropped, as are damaged lines and values."""
    run = write(
        tmp_path,
        step(1, 0.5, 12.0, rgb=0.3),
        step(5, 5, 30.0),
        step(9, 9),
        {"damaged": "step-9: model"},
        step(5, 5.5, 31.0, rgb=0.1, content=2.0),
        {"step": 7, "skipped": "rgb"},
        '{"step": 8, "seconds": 9, "psnr": NaN, "kept": true}',
        "[1]",
        '{"step": 9, "seco',
    )
    (history,) = read_history(run)
    assert (history.name, history.step, history.seconds) == ("", [1, 5, 8], [0.5, 5.5, 9.0])
    assert history.values == {
        "psnr": [12.0, 31.0, None],
        "rgb": [0.3, 0.1, None],
        "content": [None, 2.0, None],
        "kept": [None, None, None],
    }
    assert history.notes == ["damaged: step-9: model", "step: 7, skipped: rgb"]
    for part in ("cells/01", "cells/00", "overview"):
        write(run / part, step(1, 0.5))
    assert [history.name for history in read_history(run)] == ["", "overview", "00", "01"]


def test_what_is_absent_or_damaged_is_refused(world: World, run: Run) -> None:
    (run.root / "style.safetensors").unlink()
    with pytest.raises(CheckpointError):
        run.load_tensors("style")
    scene = parse_scene(world.town, 1, None)
    (run.root / IMAGES).write_text("[]")
    with pytest.raises(CheckpointError):
        check_images(run.root, scene, {})
    save_image_hashes(run.root, {"old": "0" * 64})
    with pytest.raises(UsageError):
        check_images(run.root, scene, image_hashes(scene))
    with pytest.raises(DataError):
        image_hashes(replace(scene, paths=(run.root / "gone.png",)))


def test_facts_of_fields_are_told_from_those_of_a_scene(world: World) -> None:
    facts = world.prepared.facts
    document = facts_to_json(facts)
    assert facts.field is not None and document["channels"] == facts.field.channels
    assert facts_from_json(json.loads(json.dumps(document))) == facts
    bare = replace(facts, field=None)
    assert not {"field", "channels"} & facts_to_json(bare).keys()
    # Scenes of Gaussians from before the two were told apart hold empty facts of fields.
    before = {"channels": 0, "dim": 0, "content_encoder": "", "content_scale": 1.0}
    assert facts_from_json(json.loads(json.dumps(facts_to_json(bare) | before))) == bare
    with pytest.raises(CheckpointError, match="fields"):
        _ = bare.of_field
    with pytest.raises(ConfigError, match="channels"):
        facts_from_json(json.loads(json.dumps(document | {"channels": 2**20})))
